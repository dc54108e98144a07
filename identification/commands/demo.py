"""`robot-identify demo`: record simulated drives, fit, and compare with the true parameters."""

import argparse
from dataclasses import replace
from pathlib import Path

from acquisition.commands import Progress, add_flag, add_overwrite, add_path

from .arguments import make_folder, print_results

NEXT = (
    "next, with your own robot:",
    "describe it, or copy a robot.toml of replay_data: robot-identify init arm.urdf -o robot.toml",
    "check drives and bus: robot-acquire check robot.toml",
    "record; this moves the robot, so first --dry-run: robot-acquire record robot.toml -o "
    "log.mcap --track ref.csv",
    "or import: robot-acquire import log.csv --robot robot.toml",
    "fit: robot-identify fit log.mcap --json fit.json --rrd fit.rrd",
)


def add(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_path(
        parser, "--out", "DIR", "folder for results (default: session)", default=Path("session")
    )
    parser.add_argument(
        "--robot",
        choices=["scara", "tx40"],
        default="tx40",
        help="the simulated robot (default tx40)",
    )
    add_flag(
        parser,
        "--gains",
        "instead record drives in A, without and with 2 kg, and compare the drive gains with "
        "the true ones",
    )
    add_flag(parser, "--all", "print the whole fits by least squares and iv, and all parameters")
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    """Record, fit by both methods, draw, and print both fits beside the true
    values; or drive gains alone.
    """
    if options.gains:
        _identify_gains(options)
        return
    with Progress("starting") as progress:
        from acquisition.files import atomic_write, refuse_clash
        from acquisition.robot import load_robot

        from ..data import load_signals
        from ..methods import Iteration
        from ..regression import Overrides
        from ..report import write_json
        from ..results import PARAMETERS, fit_document, fit_file, identify_iv, identify_ls
        from ..study import (
            base_file,
            description,
            record_simulated_session,
            study_truth,
            truth_document,
        )
        from ..view import draw_fit, write_rrd

        place, out = description(options.robot), options.out
        refuse_clash(
            [],
            *(out / name for name in ("session.mcap", "truth.json", "ls.json", "iv.json")),
            out / "demo.rrd",
            overwrite=options.overwrite,
            option="--out",
        )
        robot = load_robot(place)
        make_folder(out)
        with atomic_write(out / "session.mcap") as recording:
            progress.say("simulated drives")
            record_simulated_session(robot, str(place), recording)
        signals = load_signals(out / "session.mcap")
        base, true = study_truth(robot)
        write_json(out / "truth.json", base_file(base, robot, true))
        progress.say("least squares")
        ls = identify_ls(signals, Overrides())
        law = Overrides(law=ls.law)
        fits = {"ls": ls, "iv": identify_iv(signals, law, Iteration(), say=progress.say)}
        reports = [fit_document(fit_file(fit)) for fit in fits.values()]
        for name, fit in fits.items():
            write_json(out / f"{name}.json", fit_file(fit))
        progress.say("writing the Rerun file")
        write_rrd(out / "demo.rrd", draw_fit(fits["iv"], truth=true))
    compared = truth_document(robot.name, list(fits.values()), true)
    if options.all:
        print_results(*reports, compared)
    else:  # the true values in place of the table of parameters
        sections = (
            compared.sections[0] if s.title == PARAMETERS else s for s in reports[-1].sections
        )
        print_results(replace(reports[-1], sections=tuple(sections)), everything=False)
    print_results(f"open the plots: rerun --bind 127.0.0.1 {out / 'demo.rrd'}", *NEXT)


def _identify_gains(options: argparse.Namespace) -> None:
    """Record without and with a payload, identify the drive gains, and print
    them beside the true ones.
    """
    out, paths = options.out, (options.out / "free.mcap", options.out / "loaded.mcap")
    with Progress("starting") as progress:
        from acquisition.files import refuse_clash
        from acquisition.robot import load_robot

        from ..data import RecordingFile, Recordings
        from ..regression import Overrides
        from ..report import write_json
        from ..results import fit_file, identify
        from ..study import description, gains_document, record_gain_pair

        place = description(options.robot)
        refuse_clash([], *paths, out / "k.json", overwrite=options.overwrite, option="--out")
        make_folder(out)
        progress.say("simulated drives")
        true = record_gain_pair(load_robot(place), str(place), paths)
        recordings = Recordings(sources=tuple(RecordingFile.at(path) for path in paths))
        fit = identify(recordings, Overrides(gains=("all",)), say=progress.say)
        write_json(out / "k.json", fit_file(fit))
    print_results(gains_document(fit, true))
    print_results(f"the whole fit: robot-identify fit {paths[0]} {paths[1]} --gains")
