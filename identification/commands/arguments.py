"""Arguments that commands share, the objects made from them, and exit statuses.

Options have the names of the fields that they set: `acquisition.commands.from_options`.
"""

import argparse
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from acquisition.commands import Progress, add_path
from acquisition.errors import COMMAND_LINE, Location, one_line

from ..options import workers

if TYPE_CHECKING:
    from .. import data, report, view


def add_robot(parser: argparse.ArgumentParser, text: str) -> "argparse._ArgumentGroup":
    """Declare the inputs group with the robot.

    `text` names the required parts of the description of the robot.
    """
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT.toml", f"robot description; {text}")
    return inputs


def add_recordings(
    inputs: "argparse._ArgumentGroup", text: str = "one or more recordings of one robot"
) -> None:
    """Declare the recordings, and an optional description instead of their own."""
    add_path(inputs, "recordings", "LOG.mcap", text, nargs="+")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recorded one")
    inputs.add_argument(
        "--payload",
        metavar="NAME=KG[@X,Y,Z]",
        action="append",
        default=[],
        help="payload of the recording NAME, in place of the recorded one: mass in kg and centre "
        "of mass in m, none, or unknown; repeat for each recording",
    )


def add_method(settings: "argparse._ActionsContainer") -> None:
    """Declare `--method`."""
    settings.add_argument(
        "--method",
        choices=["ols", "wls", "iv"],
        type=str.lower,
        help="ols: ordinary least squares; wls: least squares weighted by joint; iv: instrumental "
        "variables (default: iv if every recording has its reference, else wls)",
    )


def sources(
    options: argparse.Namespace, description: Mapping[str, bytes] | None = None
) -> list["data.RecordingFile"]:
    """Return the recordings of `add_recordings`, not yet read.

    The files of a `description` replace those that the options name.
    """
    from acquisition.robot import load_robot

    from ..data import RecordingFile

    files, payloads = load_robot(options.robot).files if options.robot else {}, dict[str, str]()
    for text in getattr(options, "payload", ()):
        name, _, payload = text.partition("=")
        names = [x for path in options.recordings for x in (path.name, path.stem)]
        COMMAND_LINE.require(
            payload and name in names,
            "--payload",
            text,
            "NAME=KG[@X,Y,Z], NAME=none or NAME=unknown, where NAME is one of "
            f"{', '.join(names[1::2])}",
        )
        payloads[name] = payload
    return [
        RecordingFile(
            path=str(path.absolute()),
            description=tuple((description or files).items()) or None,
            payload=payloads.get(path.name, payloads.get(path.stem)),
        )
        for path in options.recordings
    ]


def add_work(parser: argparse.ArgumentParser) -> None:
    """Declare where tasks run: on the cores of this machine, or on a cluster."""
    parser.add_argument_group("processes").add_argument(
        "--workers",
        type=workers,
        metavar="N",
        help="number of processes, or address of a Dask scheduler, such as tcp://HOST:8786 "
        "(default: all cores)",
    )


def work_of(options: argparse.Namespace, tasks: int) -> "data.Work":
    """Return the workers of `add_work`, by default one for each of so many tasks."""
    from ..data import Work

    return Work(options.workers or min(os.cpu_count() or 1, tasks))


def add_report(outputs: "argparse._ActionsContainer") -> None:
    """Declare `--report`."""
    add_path(
        outputs, "--report", "FILE", "write the report: .md for tables, .html for tables and plots"
    )


def add_pictures(outputs: "argparse._ActionsContainer", text: str) -> None:
    """Declare `--report` and `--rrd`; `text` says what the Rerun file draws."""
    add_report(outputs)
    add_path(outputs, "--rrd", "FILE", text)


def show_results(
    options: argparse.Namespace,
    document: "report.Document",
    content: Callable[[], Any],
    draw: "Callable[[ModuleType], list[view.Picture]] | None" = None,
    rrds: Sequence[Path] = (),
    lines: Sequence[str] = (),
) -> None:
    """Write the results of a command to its files, and print the document and the `lines`.

    The `content` goes to `--json`, plots to the files of `add_pictures`. The document and the lines
    are printed even if a file cannot be written.
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
    document: "report.Document",
    draw: "Callable[[ModuleType], list[view.Picture]]",
    rrds: Sequence[Path] = (),
) -> None:
    """Write the files of `add_pictures`: a report of all views, a Rerun file of each.

    `draw` is given the subpackage `view`.
    """
    path = options.report
    if path is not None and path.suffix == ".md":
        from acquisition.files import write_text

        from ..report import to_markdown

        write_text(path, to_markdown(document))
        path = None
    if path is not None or rrds:
        with Progress("drawing"):
            from .. import view

            pictures = draw(view)
            if path is not None:
                # of several recordings each picture's document is that of its own
                whole = view.join_pictures(pictures)
                view.write_html(
                    path, whole if len(pictures) == 1 else replace(whole, document=document)
                )
            for rrd, picture in zip(rrds, pictures, strict=False):
                view.write_rrd(rrd, picture)


def make_folder(out: Path) -> None:
    """Make a folder for results if it does not exist."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        Location(str(out)).refuse(
            text=f"the folder cannot be created ({error.strerror})", advice="Choose another folder"
        )


def refuse_outputs(
    inputs: Sequence[Path | None],
    *outputs: Path | None,
    report: Path | None = None,
    picture: Path | None = None,
    overwrite: bool | None = None,
    **of_kinds: Path | None,
) -> None:
    """Refuse outputs before any work.

    Refused are outputs that replace an input, another output, a recording or a file of another kind
    (`refuse_clash`), or lie in a missing folder, and a `report` that is neither Markdown nor HTML.
    The folder of a Rerun file, `picture`, is not checked, because the fit is printed even if the
    file cannot be written.
    """
    from acquisition.files import refuse_clash

    if report is not None:
        Location(str(report)).require(
            report.suffix in (".md", ".html"), "ending", report.suffix, ".md or .html"
        )
    refuse_clash(
        inputs,
        *outputs,
        report,
        overwrite=overwrite,
        option="out",
        of_kinds={"rrd": picture, **of_kinds},
    )
    for output in (*outputs, report, *of_kinds.values()):
        if output is not None:
            Location(str(output)).require(
                output.absolute().parent.is_dir(),
                text=f"the folder {output.parent} does not exist",
                advice="Create it, or choose another file",
            )


def print_results(*items: "report.Document | str", everything: bool = True) -> None:
    """Print reports and lines without cutting them to the width of the terminal.

    Reports are printed in their short form, or completely with `everything`.
    """
    from ..report import print_whole

    print_whole(*items, short=not everything)


def trust_status(reasons: Sequence[str]) -> int:
    """Return the exit status of a result; print `reasons` not to trust it on stderr."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
