"""`robot-identify demo`: record simulated drives, fit, and compare with the true parameters."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import Progress, add_flag, add_overwrite, add_path

from ..options import Overrides
from .arguments import make_folder, print_results

if TYPE_CHECKING:
    from acquisition.robot import Robot

NEXT = (  # by number: what to do, and its commands
    (
        "1.",
        "Describe it, or copy a robot.toml of replay_data:",
        "robot-identify init arm.urdf -o robot.toml",
    ),
    ("2.", "Check drives and bus:", "robot-acquire check robot.toml"),
    (
        "3.",
        "Design a motion and record it (moves the robot; try --dry-run first), or import a log:",
        "robot-identify excite robot.toml -o ref.csv",
        "robot-acquire record robot.toml -o log.mcap --track ref.csv",
        "robot-acquire import log.csv --robot robot.toml",
    ),
    ("4.", "Fit:", "robot-identify fit log.mcap --json fit.json --report fit.html"),
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
        help="simulated robot (default: tx40)",
    )
    add_flag(
        parser,
        "--gains",
        "record drives in A, without and with a payload of 2 kg, and compare the identified drive "
        "gains with the true ones",
    )
    add_flag(parser, "--all", "print both fits, by least squares and iv, with all parameters")
    add_overwrite(parser)


def run(options: argparse.Namespace) -> None:
    """Record, fit by both methods, draw, and print both fits beside the true values.

    With `--gains` the demo identifies drive gains alone.
    """
    (_identify_gains if options.gains else _identify)(options)


def _identify(options: argparse.Namespace) -> None:
    with Progress("starting") as progress:
        from acquisition.files import atomic_write

        from .. import data, methods, report, results, study, view

        out = options.out
        robot, place = _simulated_robot(
            options, "session.mcap", "truth.json", "ls.json", "iv.json", "demo.rrd"
        )
        with atomic_write(out / "session.mcap") as recording:
            progress.say("simulated drives")
            study.record_simulated_session(robot, place, recording)
        signals = data.load_signals(out / "session.mcap")
        base, true = study.study_truth(robot)
        report.write_json(out / "truth.json", study.base_file(base, robot, true))
        progress.say("least squares")
        ls = results.identify_ls(signals, Overrides())
        iv = results.identify_iv(
            signals, Overrides(law=ls.law), methods.Iteration(), say=progress.say
        )
        files = {"ls": results.fit_file(ls), "iv": results.fit_file(iv)}
        for name, file in files.items():
            report.write_json(out / f"{name}.json", file)
        progress.say("writing the Rerun file")
        view.write_rrd(out / "demo.rrd", view.draw_fit(files["iv"], iv.recordings[0], true))
    compared = study.truth_document(robot.name, (ls, iv), true)
    of_ls, of_iv = (results.fit_document(file) for file in files.values())
    steps = report.Section(title="Next, with your own robot", lines=NEXT)
    if options.all:
        print_results(of_ls, of_iv, compared.followed_by(steps))
    else:  # the true values in place of the table of parameters
        sections = (
            compared.sections[0] if s.title == results.PARAMETERS else s for s in of_iv.sections
        )
        print_results(replace(of_iv, sections=(*sections, steps)), everything=False)
    print_results(f"Plots: rerun --bind 127.0.0.1 {out / 'demo.rrd'}")


def _identify_gains(options: argparse.Namespace) -> None:
    """Record without and with a payload, and identify the drive gains.

    The gains are printed beside the true ones.
    """
    out, paths = options.out, (options.out / "free.mcap", options.out / "loaded.mcap")
    with Progress("starting") as progress:
        from .. import data, report, results, study

        robot, place = _simulated_robot(options, "free.mcap", "loaded.mcap", "k.json")
        progress.say("simulated drives")
        true = study.record_gain_pair(robot, place, paths)
        fit = results.identify(
            data.Recordings(sources=tuple(data.RecordingFile.at(path) for path in paths)),
            Overrides(gains=("all",)),
            say=progress.say,
        )
        report.write_json(out / "k.json", results.fit_file(fit))
    print_results(
        study.gains_document(fit, true),
        f"The whole fit: robot-identify fit {paths[0]} {paths[1]} --gains",
    )


def _simulated_robot(options: argparse.Namespace, *names: str) -> tuple["Robot", str]:
    """Return the robot to simulate and its file; make the folder for files of these `names`."""
    from acquisition.files import refuse_clash
    from acquisition.robot import load_robot

    from ..study import description

    place, outputs = description(options.robot), (options.out / name for name in names)
    refuse_clash([], *outputs, overwrite=options.overwrite, option="out")
    robot = load_robot(place)
    make_folder(options.out)
    return robot, str(place)
