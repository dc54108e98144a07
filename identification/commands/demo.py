"""`robot-identify demo`: record simulated drives, fit, and compare with the true parameters."""

import argparse
from pathlib import Path

from acquisition.commands import Progress, add_overwrite, add_path

from ..options import not_negative
from .arguments import make_folder, print_results


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(parser, "--out", "DIR", "folder for results (default: session)", default=Path("session"))
    parser.add_argument("--robot", choices=["scara", "tx40"], default="tx40", help="the simulated robot (default tx40)")
    parser.add_argument(
        "--noise", type=not_negative, default=3.0, metavar="P", help="torque noise, %% of rms (default 3)"
    )
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    """Record, fit by both methods, draw, and print both fits beside the true values."""
    with Progress("starting") as progress:
        from acquisition.files import atomic_write, refuse_clash
        from acquisition.robot import load_robot

        from ..data import load_signals
        from ..methods import Iteration, fit_document, fit_file, identify_iv, identify_ls
        from ..regression import Overrides
        from ..report import write_json
        from ..study import base_file, description, record_simulated_session, study_truth, truth_document
        from ..view import write_fit_rrd

        place, out = description(options.robot), options.out
        refuse_clash([], out / "session.mcap", overwrite=options.overwrite, option="--out")
        robot = load_robot(place)
        make_folder(out)
        with atomic_write(out / "session.mcap") as recording:
            record_simulated_session(robot, str(place), recording, progress.say, noise_percent=options.noise)
        signals = load_signals(out / "session.mcap")
        base, true = study_truth(robot)
        write_json(out / "truth.json", base_file(base, robot, true))
        fits = {}
        progress.say("least squares")
        fits["ls"] = identify_ls(signals, Overrides())
        fits["iv"] = identify_iv(signals, Overrides(), Iteration(), say=progress.say)
        reports = {name: fit_document(signals, fit) for name, fit in fits.items()}
        for name, fit in fits.items():
            write_json(out / f"{name}.json", fit_file(fit))
        progress.say("writing the Rerun file")
        write_fit_rrd(out / "demo.rrd", signals, fits["iv"], truth=true)
    print_results(*reports.values(), truth_document(robot.name, list(fits.values()), true))
    print_results(f"look at it: rerun --bind 127.0.0.1 {out / 'demo.rrd'}")
