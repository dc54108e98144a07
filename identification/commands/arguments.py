"""Arguments that commands share, what is made of them, and how commands end.

Options have the names of the fields that they set: `acquisition.commands.from_options`.
"""

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from acquisition.commands import add_options, add_path
from acquisition.errors import one_line

from ..errors import IdentificationError
from ..options import CellOptions, Overrides, StudyOptions, list_of_names, list_of_values, positive

if TYPE_CHECKING:
    from acquisition.robot import Robot

    from ..data import RecordingFile, Work
    from ..export import Chain
    from ..report import Document

_STATED = {
    "--range": ("Q", "positions, rad or m to each side of zero; where the URDF has limits too, the narrower hold"),
    "--speed": ("V", "largest speed, rad/s or m/s; where the URDF has one too, the smaller holds"),
    "--acceleration": ("A", "largest acceleration, rad/s² or m/s²"),
    "--following-error": ("Q", "largest following error, rad or m"),
    "--bandwidth-hz": ("F", "bandwidth of the position loop; of several the lowest holds"),
}


def add_robot(parser: argparse.ArgumentParser, text: str) -> "argparse._ArgumentGroup":
    """The group of inputs with the robot, and the options of a URDF; `text` says what of a description is needed."""
    inputs = parser.add_argument_group("inputs")
    add_path(inputs, "robot", "ROBOT", f"robot.toml or a URDF; {text}")
    add_urdf_options(parser)
    return inputs


def add_urdf_options(parser: argparse.ArgumentParser) -> None:
    """Options for what a URDF does not say."""
    group = parser.add_argument_group("with a URDF: one value for all joints, or one per joint, as A,B,C")
    text = "the joints to identify, from the base outwards (default: those of the longest serial chain)"
    group.add_argument("--joints", type=list_of_names, metavar="A,B", help=text)
    for option, (metavar, text) in _STATED.items():
        group.add_argument(option, type=list_of_values, metavar=metavar, help=text)


def robot_of(options: argparse.Namespace, *, moves: bool = False) -> "Robot":
    """The robot that the options of `add_robot` describe; where it `moves`, a URDF or its options must state the limits."""
    from acquisition.robot import load_robot

    from ..export import is_urdf, robot_of_chain

    if is_urdf(options.robot):
        return robot_of_chain(chain_of(options), moves=moves)
    for option in (*(["--joints"] if options.joints is not None else []), *_stated(options)):
        expected = "a URDF with it: robot.toml has a key of its own for it"
        raise IdentificationError(f"{option} does nothing here", place=str(options.robot), expected=expected)
    return load_robot(options.robot)


def chain_of(options: argparse.Namespace) -> "Chain":
    """The chain of the URDF, with what the options state."""
    from ..export import read_chain

    return read_chain(options.robot, options.joints or ()).with_options(_stated(options))


def _stated(options: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """By name, the options given for what a URDF does not say."""
    given = {option: getattr(options, option.removeprefix("--").replace("-", "_")) for option in _STATED}
    return {option: values for option, values in given.items() if values is not None}


def add_simulation(parser: argparse.ArgumentParser, **noise: float) -> None:
    """Length, rate, seed and imperfections of a simulated recording; `noise` are defaults other than those of the fields."""
    group = parser.add_argument_group("simulated recording")
    add_options(group, StudyOptions, "duration_s", "period_s", "sample_rate_hz", "seed", seed=1)
    add_options(parser.add_argument_group("imperfections of the simulated cell"), CellOptions, **noise)


def add_recordings(inputs: "argparse._ArgumentGroup") -> None:
    """The recordings, and a description used instead of their own."""
    add_path(inputs, "recordings", "LOG.mcap", "the recording, or several of one robot", nargs="+")
    add_path(inputs, "--robot", "ROBOT.toml", "use this description instead of the recording's own")


def add_settings(parser: argparse.ArgumentParser, *, method: bool = False) -> "argparse._ArgumentGroup":
    """The group of settings: what of a recording is fitted, how it is filtered, and, with `method`, how and from which rows."""
    group = parser.add_argument_group("settings of the fit")
    add_options(group, Overrides, "cutoff_hz", "decimation", "span", "torque_lag_s")
    if method:
        text = (
            "least squares, ordinary or weighted joint by joint; or instrumental variables (default: iv where every recording "
            "has its reference, else wls)"
        )
        group.add_argument("--method", choices=["ols", "wls", "iv"], help=text)
        add_options(group, Overrides, "low_speed_percent")
    return group


def sources(options: argparse.Namespace) -> list["RecordingFile"]:
    """The files of the recordings of `add_recordings`, to be read where they are needed."""
    from acquisition.robot import load_robot

    from ..data import RecordingFile

    robot = load_robot(options.robot) if options.robot else None
    return [RecordingFile.at(path, robot) for path in options.recordings]


def add_work(parser: argparse.ArgumentParser) -> None:
    """Where tasks run: on the cores of this machine, or on a cluster."""
    where = parser.add_argument_group("where it runs").add_mutually_exclusive_group()
    where.add_argument("--workers", type=positive, metavar="N", help="processes on this machine (default: all cores)")
    text = "the Dask scheduler whose workers do the work, on other machines too"
    where.add_argument("--cluster", metavar="tcp://HOST:8786", help=text)


@contextmanager
def work_of(options: argparse.Namespace, tasks: int) -> Iterator["Work"]:
    """What `add_work` asks for, for so many tasks at a time."""
    from ..data import cluster, processes

    cores = options.workers or os.cpu_count() or 1
    with processes(min(cores, tasks)) if options.cluster is None else cluster(options.cluster) as work:
        yield work


def make_folder(out: Path) -> None:
    """Make a folder for results where there is none."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IdentificationError(f"cannot be made: {error.strerror}", place=str(out), expected="a folder") from error


def refuse_outputs(
    inputs: Sequence[Path | None], *outputs: Path | None, picture: Path | None = None, overwrite: bool | None = None
) -> None:
    """Before any work: no output may replace an input, another output or a recording, or name a folder that is not there.

    The folder of a `picture` is not checked: the fit is printed even if its picture cannot be written.
    """
    from acquisition.files import refuse_clash

    refuse_clash(inputs, *outputs, picture, overwrite=overwrite)
    for output in outputs:
        if output is not None and not output.absolute().parent.is_dir():
            raise IdentificationError(f"no folder {output.parent}", place=str(output), expected="a folder that exists")


def print_results(*items: "Document | str") -> None:
    """Reports and lines on standard output, whole whatever its width."""
    from ..report import print_whole

    print_whole(*items)


def trust_status(reasons: Sequence[str]) -> int:
    """The exit status of a result; one that is not to be trusted has a line on stderr that says why."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
