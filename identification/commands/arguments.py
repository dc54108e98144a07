"""Arguments that commands share, the objects made from them, and exit statuses.

Options have the names of the fields that they set: `acquisition.commands.from_options`.
"""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from acquisition.commands import Progress, add_path
from acquisition.errors import one_line

from ..errors import BadInputError
from ..options import workers

if TYPE_CHECKING:
    from ..data import RecordingFile, Work
    from ..report import Document
    from ..view import Picture

# what older versions had: a command, an option, or an option of one command;
# and what to use instead
GONE = {
    "schema": "all keys of robot.toml are in identification/reference.md",
    "sensitivity": "use study LOG.mcap",
    "study --cutoffs": "use study LOG.mcap, which varies the cut-off",
    "study --starts": "use study LOG.mcap, which varies the start",
    "study --low-speed-percent": "state low_speed_percent in [identification]",
    "study --encoder-step": "use --position-noise",
    "study --rrd": "use --report FILE.html",
    "--all-samples": 'use span = "all" under [identification] of robot.toml',
    **{
        name: f"use {key} under [identification] of robot.toml"
        for key, names in {
            "cutoff_hz": ["fleet --cutoff-hz"],
            "decimation": ["--decimate"],
            "low_speed_percent": [
                f"{command} --low-speed-percent" for command in ("fit", "friction", "fleet")
            ],
            "max_iterations": ["--max-iterations"],
            "tolerance_percent": ["--tolerance-percent"],
            "torque_lag_s": ["fleet --torque-lag-s", "view --torque-lag-s"],
        }.items()
        for name in names
    },
    "--cluster": "use --workers tcp://HOST:8786",
    "compare --rrd": "use --report FILE.html, which has the charts",
    "demo --noise": "use simulate --effort-noise-percent",
    "friction --rrd": "use --report FILE.html, which has the charts",
    **dict.fromkeys(
        ["fleet --rrd", "fleet --report"], "use the table of -o OUT.csv, which marks changes"
    ),
}


def add_robot(parser: argparse.ArgumentParser, text: str) -> "argparse._ArgumentGroup":
    """The inputs group with the robot; `text` names the required parts of its description."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT.toml", f"the robot's description; {text}")
    return inputs


def add_recordings(inputs: "argparse._ArgumentGroup") -> None:
    """The recordings, and an optional description instead of their own."""
    add_path(inputs, "recordings", "LOG.mcap", "one or more recordings of one robot", nargs="+")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recording's own")
    inputs.add_argument(
        "--payload",
        metavar="NAME=KG[@X,Y,Z]",
        action="append",
        default=[],
        help="what the robot carried in the recording NAME, instead of what is stored there: kg "
        "and centre of mass in m, none, or unknown; once for each recording",
    )


def add_method(settings: "argparse._ActionsContainer") -> None:
    """`--method`."""
    settings.add_argument(
        "--method",
        choices=["ols", "wls", "iv"],
        type=str.lower,
        help="ols: ordinary least squares; wls: weighted by joint; iv: instrumental variables "
        "(default: iv if every recording has its reference, else wls)",
    )


def sources(options: argparse.Namespace) -> list["RecordingFile"]:
    """The recordings of `add_recordings`, not yet read."""
    from acquisition.robot import load_robot

    from ..data import RecordingFile

    robot, payloads = load_robot(options.robot) if options.robot else None, dict[str, str]()
    for text in getattr(options, "payload", ()):
        name, _, payload = text.partition("=")
        names = [x for path in options.recordings for x in (path.name, path.stem)]
        if not payload or name not in names:
            raise BadInputError(
                key="--payload",
                value=text,
                expected="NAME=KG[@X,Y,Z], NAME=none or NAME=unknown with a NAME of "
                f"{', '.join(names[1::2])}",
            )
        payloads[name] = payload
    return [
        RecordingFile.at(path, robot, payloads.get(path.name, payloads.get(path.stem)))
        for path in options.recordings
    ]


def add_work(parser: argparse.ArgumentParser) -> None:
    """Where tasks run: on the cores of this machine, or on a cluster."""
    parser.add_argument_group("where it runs").add_argument(
        "--workers",
        type=workers,
        metavar="N",
        help="number of processes (default: all cores), or the address of a Dask scheduler, as "
        "tcp://HOST:8786",
    )


def work_of(options: argparse.Namespace, tasks: int) -> "Work":
    """The workers of `add_work`, by default one for each of so many tasks."""
    from ..data import Work

    return Work(options.workers or min(os.cpu_count() or 1, tasks))


def add_report(outputs: "argparse._ActionsContainer") -> None:
    """`--report`."""
    add_path(
        outputs, "--report", "FILE", "write the report: .md has the tables, .html also the pictures"
    )


def add_pictures(outputs: "argparse._ActionsContainer", text: str) -> None:
    """`--report` and `--rrd`; `text` says what the Rerun file draws."""
    add_report(outputs)
    add_path(outputs, "--rrd", "FILE", text)


def show_results(
    options: argparse.Namespace,
    document: "Document",
    content: Callable[[], Any],
    draw: "Callable[[ModuleType], list[Picture]] | None" = None,
    rrds: Sequence[Path] = (),
    lines: Sequence[str] = (),
) -> None:
    """Write the `content` as `--json` and the files of `add_pictures`, and print the document
    and the `lines`, even if a file cannot be written.
    """
    from ..report import write_json

    try:
        if options.json:
            write_json(options.json, content())
        if draw is not None:
            write_pictures(options, document, draw, rrds)
    finally:
        print_results(document, *lines, everything=options.all)


def write_pictures(
    options: argparse.Namespace,
    document: "Document",
    draw: "Callable[[ModuleType], list[Picture]]",
    rrds: Sequence[Path] = (),
) -> None:
    """Write the files of `add_pictures`: a report of all pictures, a Rerun file of each; `draw` is
    given the room `view`.
    """
    report = options.report
    if report is not None and report.suffix == ".md":
        from acquisition.files import write_text

        from ..report import to_markdown

        write_text(report, to_markdown(document))
        report = None
    if report is None and not rrds:
        return
    with Progress("drawing"):
        from .. import view

        pictures = draw(view)
        if report is not None:
            # of several recordings each picture's document is that of its own
            whole = view.join_pictures(pictures)
            view.write_html(
                report, whole if len(pictures) == 1 else replace(whole, document=document)
            )
        for rrd, picture in zip(rrds, pictures, strict=False):
            view.write_rrd(rrd, picture)


def make_folder(out: Path) -> None:
    """Make a folder for results if it does not exist."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInputError(
            f"cannot be created: {error.strerror}", place=str(out), expected="a folder"
        ) from error


def refuse_outputs(
    inputs: Sequence[Path | None],
    *outputs: Path | None,
    report: Path | None = None,
    picture: Path | None = None,
    overwrite: bool | None = None,
    **of_kinds: Path | None,
) -> None:
    """Before any work: refuse outputs that replace an input, another output, a recording or a file
    of another kind (`refuse_clash`), or lie in a missing folder, and a `report` that is neither
    Markdown nor HTML.

    The folder of a `picture`, a Rerun file, is not checked, because the fit is printed even if the
    picture cannot be written.
    """
    from acquisition.files import refuse_clash

    if report is not None and report.suffix not in (".md", ".html"):
        raise BadInputError(
            place=str(report), key="ending", value=report.suffix, expected=".md or .html"
        )
    refuse_clash(
        inputs, *outputs, report, overwrite=overwrite, of_kinds={"rrd": picture, **of_kinds}
    )
    for output in (*outputs, report, *of_kinds.values()):
        if output is not None and not output.absolute().parent.is_dir():
            raise BadInputError(
                f"no folder {output.parent}", place=str(output), expected="an existing folder"
            )


def print_results(*items: "Document | str", everything: bool = True) -> None:
    """Print reports and lines without cutting them to the width of the terminal; reports in
    short, or `everything`.
    """
    from ..report import print_whole

    print_whole(*items, short=not everything)


def trust_status(reasons: Sequence[str]) -> int:
    """The exit status of a result; `reasons` not to trust it are printed on stderr."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
