"""Options that commands share, and their values: text in, a number in its range out, `ValueError` otherwise.

Options have the names of the fields that they set, of `Overrides` and `Noise`: `acquisition.commands.from_options`.
"""

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ..errors import IdentificationError

if TYPE_CHECKING:
    from ..data import RecordingFile, Signals, Work


def add_simulation_options(
    parser: argparse.ArgumentParser, *, encoder_step: float = 0.0, effort_noise_percent: float = 0.0
) -> None:
    """Length, rate, seed and noise of a simulated recording, with the noise that is the default."""
    group = parser.add_argument_group("simulated recording")
    group.add_argument("--duration-s", type=above_zero, default=10.0, metavar="S", help="length (default 10)")
    group.add_argument(
        "--period-s",
        type=above_zero,
        default=10.0,
        metavar="S",
        help="about the period of the reference; whole periods make up the length (default 10)",
    )
    group.add_argument(
        "--rate-hz",
        dest="sample_rate_hz",
        type=above_zero,
        default=1000.0,
        metavar="F",
        help="sample rate (default 1000)",
    )
    group.add_argument("--seed", type=whole, default=1, metavar="K", help="seed of reference and noise (default 1)")
    add_imperfections(parser, encoder_step=encoder_step, effort_percent=effort_noise_percent)


def add_imperfections(parser: argparse.ArgumentParser, **defaults: float) -> None:
    """What the simulated cell has and its description does not: an option for each field of `Noise`, with other defaults."""
    group = parser.add_argument_group("imperfections of the simulated cell")
    for option, field, kind, metavar, text in (
        ("--encoder-step", "encoder_step", not_negative, "Q", "step of the encoder, rad or m"),
        ("--position-noise", "position", not_negative, "Q", "noise of the encoder, rad or m rms"),
        ("--effort-noise-percent", "effort_percent", not_negative, "P", "white noise of the torque, %% of its rms"),
        (
            "--effort-coloured-percent",
            "coloured_percent",
            not_negative,
            "P",
            "AR(0.98) noise of the torque, %% of its rms",
        ),
        ("--disturbance-percent", "disturbance_percent", not_negative, "P", "AR(0.98) torque that acts, %% of the rms"),
        ("--lag-samples", "lag_samples", whole, "K", "samples by which the recorded torque is late"),
        ("--stribeck-percent", "stribeck_percent", not_negative, "P", "more Coulomb friction at rest, %% of itself"),
        (
            "--asymmetry-percent",
            "asymmetry_percent",
            share,
            "P",
            "friction larger forwards, smaller backwards, %% of itself",
        ),
        ("--integral-hz", "integral_hz", not_negative, "F", "rate of an integral of the controller, 0 for none"),
    ):
        default = kind(str(defaults.get(field, 0)))
        text = f"{text} (default {default:g})"
        group.add_argument(option, dest=field, type=kind, default=default, metavar=metavar, help=text)
    group.add_argument(
        "--effort-recorded",
        dest="recorded",
        choices=["mean", "tick"],
        default="mean",
        help="torque as the mean of the periods before and after, or the command of its tick (default mean)",
    )


def add_recording(parser: argparse.ArgumentParser, *before: str) -> None:
    """The group of inputs: files that come before, the recordings, and a description used instead of their own."""
    inputs = parser.add_argument_group("inputs")
    for name in before:
        inputs.add_argument(
            name, type=Path, metavar=f"{name.upper()}.json", help=f"the {name}, as `fit --json` writes it"
        )
    inputs.add_argument(
        "recordings", type=Path, nargs="+", metavar="LOG.mcap", help="the recording, or several of one robot"
    )
    inputs.add_argument(
        "--robot", type=Path, metavar="ROBOT.toml", help="use this description instead of the recording's own"
    )


def add_settings(parser: argparse.ArgumentParser) -> "argparse._ArgumentGroup":
    """The group of settings: what of a recording is fitted, and how it is filtered."""
    group = parser.add_argument_group("settings of the fit")
    group.add_argument(
        "--cutoff-hz",
        type=cutoff,
        metavar="F",
        help="low-pass of the position, Hz, or none (default: 5 times the bandwidth)",
    )
    group.add_argument("--decimate", dest="decimation", type=positive, metavar="N", help="samples per decimated row")
    group.add_argument(
        "--all-samples",
        dest="span",
        action="store_const",
        const="all",
        help="also use the standstill before and after the motion",
    )
    group.add_argument(
        "--torque-lag-s",
        type=seconds_or_none,
        metavar="S",
        help="known lag of the recorded torque, s, positive where it is late: corrected (default: half a period early for a "
        "held command), or none",
    )
    return group


def add_method(settings: "argparse._ArgumentGroup") -> None:
    """How parameters are estimated, and from which rows."""
    settings.add_argument(
        "--method",
        choices=["ols", "wls", "iv"],
        help="least squares, ordinary or weighted joint by joint; or instrumental variables (default: iv where every recording "
        "has its reference, else wls)",
    )
    settings.add_argument(
        "--low-speed-percent",
        type=share,
        metavar="P",
        help="leave out rows slower than P %% of the peak speed (default: 4, or 4 deviations of the speed's noise)",
    )


def load(options: argparse.Namespace) -> list["Signals"]:
    """The recordings of `add_recording`, by the description given in place of their own."""
    return [source.load() for source in sources(options)]


def sources(options: argparse.Namespace) -> list["RecordingFile"]:
    """The files of the recordings of `add_recording`, to be read where they are needed."""
    from acquisition.robot import load_robot

    from ..data import RecordingFile

    robot = load_robot(options.robot) if options.robot else None
    return [RecordingFile.at(path, robot) for path in options.recordings]


def add_work(parser: argparse.ArgumentParser) -> None:
    """Where tasks run: on the cores of this machine, or on a cluster."""
    group = parser.add_argument_group("where it runs")
    where = group.add_mutually_exclusive_group()
    where.add_argument("--workers", type=positive, metavar="N", help="processes on this machine (default: all cores)")
    where.add_argument(
        "--cluster",
        metavar="tcp://HOST:8786",
        help="the Dask scheduler whose workers do the work, on other machines too",
    )


@contextmanager
def work_of(options: argparse.Namespace, tasks: int) -> Iterator["Work"]:
    """What `add_work` asks for, for so many tasks at a time."""
    from ..data import cluster, processes

    if options.cluster is not None:
        with cluster(options.cluster) as work:
            yield work
    else:
        cores = options.workers or (os.cpu_count() or 1)
        with processes(min(cores, tasks)) as work:
            yield work


def make_folder(out: Path) -> None:
    """Make a folder for results where there is none."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise IdentificationError(f"cannot be made: {error.strerror}", place=str(out), expected="a folder") from error


def refuse_outputs(
    inputs: Sequence[Path | None],
    *outputs: Path | None,
    picture: Path | None = None,
    overwrite: bool | None = None,
) -> None:
    """Before any work: no output may replace an input, another output or a recording, or name a folder that is not there.

    The folder of a `picture` is not checked: the fit is printed even if its picture cannot be written.
    """
    from acquisition.files import refuse_clash

    refuse_clash(inputs, *outputs, picture, overwrite=overwrite)
    for output in outputs:
        if output is not None and not output.absolute().parent.is_dir():
            raise IdentificationError(f"no folder {output.parent}", place=str(output), expected="a folder that exists")


def not_negative(text: str) -> float:
    """A finite number from 0."""
    return 0.0 if float(text) == 0 else above_zero(text)


def cutoffs(text: str) -> tuple[float, ...]:
    """Cut-offs separated by commas."""
    return tuple(cutoff(part) for part in text.split(","))


def factors(text: str) -> tuple[float, ...]:
    """Numbers above 0 separated by commas."""
    return tuple(above_zero(part) for part in text.split(","))


def controllers(text: str) -> tuple[str, ...]:
    """What a fit is told of the controller, separated by commas."""
    names = tuple(text.split(","))
    if not set(names) <= {"described", "none"}:
        raise ValueError(text)
    return names


def share(text: str) -> float:
    """A percentage from 0 to below 100."""
    value = float(text)
    if not 0 <= value < 100:
        raise ValueError(text)
    return value


def cutoff(text: str) -> float:
    """A cut-off above 0, or 0 for `none`."""
    return 0.0 if text == "none" else above_zero(text)


def seconds_or_none(text: str) -> float | Literal["none"]:
    """A finite number of seconds, or `none`."""
    return "none" if text == "none" else finite(text)


def finite(text: str) -> float:
    """A finite number."""
    return _above(text, -float("inf"))


def above_zero(text: str) -> float:
    """A finite number above 0."""
    return _above(text, 0.0)


def _above(text: str, least: float) -> float:
    value = float(text)
    if not least < value < float("inf"):
        raise ValueError(text)
    return value


def whole(text: str) -> int:
    """A whole number from 0."""
    return _from(text, 0)


def positive(text: str) -> int:
    """A whole number from 1."""
    return _from(text, 1)


def at_least_two(text: str) -> int:
    """A whole number from 2."""
    return _from(text, 2)


def _from(text: str, least: int) -> int:
    value = int(text)
    if value < least:
        raise ValueError(text)
    return value


def percent(text: str) -> float:
    """A percentage above 0, to 100."""
    value = float(text)
    if not 0 < value <= 100:
        raise ValueError(text)
    return value
