"""Arguments that commands share, the objects made from them, and exit statuses.

Options have the names of the fields that they set: `acquisition.commands.from_options`.
"""

import argparse
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from acquisition.commands import Progress, add_options, add_path
from acquisition.errors import one_line

from ..errors import IdentificationError
from ..options import CellOptions, Overrides, StudyOptions, list_of_names, list_of_values, positive

if TYPE_CHECKING:
    from acquisition.robot import Robot

    from ..data import RecordingFile, Work
    from ..export import Chain
    from ..report import Document
    from ..view import Picture

GONE = {  # what older versions had: a command, an option, or an option of one command; and what to use instead
    "schema": "all keys of robot.toml are in identification/reference.md",
    "sensitivity --rrd": "use --report FILE.html, which has the charts",
    "compare --rrd": "use --report FILE.html, which has the charts",
    "friction --rrd": "use --report FILE.html, which has the charts",
}
_URDF_OPTIONS = {
    "--range": ("Q", "position limits, ± rad or m; if the URDF has limits too, the narrower are used"),
    "--speed": ("V", "maximum speed, rad/s or m/s; if the URDF has one too, the smaller is used"),
    "--acceleration": ("A", "maximum acceleration, rad/s² or m/s²"),
    "--following-error": ("Q", "maximum following error, rad or m"),
    "--bandwidth-hz": ("F", "bandwidth of the position loop in Hz; if several are given, the lowest is used"),
}


def add_robot(parser: argparse.ArgumentParser, text: str) -> "argparse._ArgumentGroup":
    """The inputs group with the robot, and the options of a URDF; `text` names the required parts of a description."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT", f"robot.toml or a URDF; {text}")
    add_urdf_options(parser)
    return inputs


def add_urdf_options(parser: argparse.ArgumentParser) -> None:
    """Options for values that a URDF does not have."""
    group = parser.add_argument_group("with a URDF: one value for all joints, or one per joint, as A,B,C")
    text = "joints to identify, from the base outwards (default: the longest serial chain)"
    group.add_argument("--joints", type=list_of_names, metavar="A,B", help=text)
    for option, (metavar, text) in _URDF_OPTIONS.items():
        group.add_argument(option, type=list_of_values, metavar=metavar, help=text)


def robot_of(options: argparse.Namespace, *, moves: bool = False) -> "Robot":
    """The robot of the options of `add_robot`; if it `moves`, a URDF or its options must state the limits."""
    from ..export import read_robot

    return read_robot(options.robot, options.joints or (), _stated(options), moves=moves)


def chain_of(options: argparse.Namespace) -> "Chain":
    """The chain of the URDF, with the values of the options."""
    from ..export import chain_of_letters, read_chain

    letters = getattr(options, "dh", None)
    chain = read_chain(options.robot, options.joints or ()) if letters is None else chain_of_letters(letters)
    return chain.with_options(_stated(options))


def _stated(options: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """The given options of `add_urdf_options`, by name."""
    given = {option: getattr(options, option.removeprefix("--").replace("-", "_")) for option in _URDF_OPTIONS}
    return {option: values for option, values in given.items() if values is not None}


def add_simulation(parser: argparse.ArgumentParser, **noise: float) -> None:
    """Length, rate, seed and imperfections of a simulated recording; `noise` replaces defaults of the fields."""
    group = parser.add_argument_group("simulated recording")
    add_options(group, StudyOptions, "duration_s", "period_s", "sample_rate_hz", "seed", seed=1)
    add_options(parser.add_argument_group("imperfections of the simulated cell"), CellOptions, **noise)


def add_recordings(inputs: "argparse._ArgumentGroup") -> None:
    """The recordings, and an optional description instead of their own."""
    add_path(inputs, "recordings", "LOG.mcap", "one or more recordings of one robot", nargs="+")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recording's own")
    text = (
        "what the robot carried in the recording NAME, instead of what is stored there: kg and centre of mass in m, none, or "
        "unknown; once for each recording"
    )
    inputs.add_argument("--payload", metavar="NAME=KG[@X,Y,Z]", action="append", default=[], help=text)


def add_settings(parser: argparse.ArgumentParser, *, method: bool = False) -> "argparse._ArgumentGroup":
    """The settings group: span and filters; with `method` also the method and the excluded rows."""
    group = parser.add_argument_group("settings of the fit")
    add_options(group, Overrides, "cutoff_hz", "decimation", "span", "torque_lag_s")
    if method:
        text = (
            "ols: ordinary least squares; wls: weighted by joint; iv: instrumental variables (default: iv if every recording "
            "has its reference, else wls)"
        )
        group.add_argument("--method", choices=["ols", "wls", "iv"], help=text)
        add_options(group, Overrides, "low_speed_percent")
    return group


def sources(options: argparse.Namespace) -> list["RecordingFile"]:
    """The recordings of `add_recordings`, not yet read."""
    from acquisition.robot import load_robot

    from ..data import RecordingFile

    robot, payloads = load_robot(options.robot) if options.robot else None, dict[str, str]()
    for text in getattr(options, "payload", ()):
        name, _, payload = text.partition("=")
        names = [x for path in options.recordings for x in (path.name, path.stem)]
        if not payload or name not in names:
            expected = f"NAME=KG[@X,Y,Z], NAME=none or NAME=unknown with a NAME of {', '.join(names[1::2])}"
            raise IdentificationError(key="--payload", value=text, expected=expected)
        payloads[name] = payload
    return [
        RecordingFile.at(path, robot, payloads.get(path.name, payloads.get(path.stem))) for path in options.recordings
    ]


def add_work(parser: argparse.ArgumentParser) -> None:
    """Options for where tasks run: on the cores of this machine, or on a cluster."""
    where = parser.add_argument_group("where it runs").add_mutually_exclusive_group()
    where.add_argument("--workers", type=positive, metavar="N", help="processes on this machine (default: all cores)")
    text = "Dask scheduler whose workers run the tasks, also on other machines"
    where.add_argument("--cluster", metavar="tcp://HOST:8786", help=text)


@contextmanager
def work_of(options: argparse.Namespace, tasks: int) -> Iterator["Work"]:
    """The processes or the cluster of `add_work`, for this number of tasks."""
    from ..data import cluster, processes

    cores = options.workers or os.cpu_count() or 1
    with processes(min(cores, tasks)) if options.cluster is None else cluster(options.cluster) as work:
        yield work


def add_report(outputs: "argparse._ActionsContainer") -> None:
    """`--report`."""
    add_path(outputs, "--report", "FILE", "write the report: .md has the tables, .html also the pictures")


def add_pictures(outputs: "argparse._ActionsContainer", text: str) -> None:
    """`--report` and `--rrd`; `text` says what the Rerun file draws."""
    add_report(outputs)
    add_path(outputs, "--rrd", "FILE", text)


def write_pictures(
    options: argparse.Namespace,
    document: "Document",
    draw: "Callable[[ModuleType], list[Picture]]",
    rrds: Sequence[Path] | None = None,
) -> None:
    """Write the files of `add_pictures`: a report of all pictures, a Rerun file of each; `draw` is given the room `view`."""
    report, rrd = options.report, getattr(options, "rrd", None)
    rrds = rrds or ([rrd] if rrd else [])
    if report is not None and report.suffix == ".md":
        from ..report import write_markdown

        write_markdown(report, document)
        report = None
    if report is None and not rrds:
        return
    with Progress("drawing"):
        from .. import view

        pictures = draw(view)
        if report is not None:
            whole = view.join_pictures(pictures)  # of several recordings each picture's document is that of its own
            view.write_html(report, whole if len(pictures) == 1 else replace(whole, document=document))
        for rrd, picture in zip(rrds, pictures, strict=False):
            view.write_rrd(rrd, picture)


def make_folder(out: Path) -> None:
    """Make a folder for results if it does not exist."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IdentificationError(
            f"cannot be created: {error.strerror}", place=str(out), expected="a folder"
        ) from error


def refuse_outputs(
    inputs: Sequence[Path | None],
    *outputs: Path | None,
    report: Path | None = None,
    picture: Path | None = None,
    overwrite: bool | None = None,
) -> None:
    """Before any work: refuse outputs that replace an input, another output or a recording, or lie in a missing folder, and a
    `report` that is neither Markdown nor HTML.

    The folder of a `picture` is not checked, because the fit is printed even if the picture cannot be written.
    """
    from acquisition.files import refuse_clash

    if report is not None and report.suffix not in (".md", ".html"):
        raise IdentificationError(place=str(report), key="ending", value=report.suffix, expected=".md or .html")
    refuse_clash(inputs, *outputs, report, picture, overwrite=overwrite)
    for output in (*outputs, report):
        if output is not None and not output.absolute().parent.is_dir():
            raise IdentificationError(f"no folder {output.parent}", place=str(output), expected="an existing folder")


def print_results(*items: "Document | str", everything: bool = True) -> None:
    """Print reports and lines without cutting them to the width of the terminal; reports in short, or `everything`."""
    from ..report import print_whole

    print_whole(*items, short=not everything)


def trust_status(reasons: Sequence[str]) -> int:
    """The exit status of a result; `reasons` not to trust it are printed on stderr."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
