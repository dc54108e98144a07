"""Options of users, each with its default, unit and help, and the functions that check them.

These functions read the values too. Subpackages use these records, and commands make options from
them (`acquisition.options`). The module has no heavy imports.
"""

from argparse import ArgumentTypeError
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from acquisition.options import option

if TYPE_CHECKING:
    from acquisition.robot import Edges, LowSpeed

INF = float("inf")
Span = Literal["motion", "all"]


def _value(
    expected: str, read: Callable[[str], Any], accepts: Callable[[Any], bool] = lambda x: True
) -> Callable[[str], Any]:
    """Return a function that reads a value; argparse shows `expected` for a refused value."""

    def value(text: str) -> Any:
        with suppress(ValueError, ArgumentTypeError):
            if accepts(found := read(text)):
                return found
        raise ArgumentTypeError(f"{text!r}: expected {expected}")

    return value


def _values(read: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda text: tuple(read(part.strip()) for part in text.split(","))


finite = _value("a number", float, lambda x: -INF < x < INF)
above_zero = _value("a number greater than 0", float, lambda x: 0 < x < INF)
rate = _value("a rate of at least 1 Hz (0.008 s is 125 Hz)", float, lambda x: 1 <= x < INF)
# The addition makes 0 of -0, which a file would show.
not_negative = _value("0 or greater", lambda text: float(text) + 0.0, lambda x: 0 <= x < INF)
percent = _value("a percentage greater than 0 and at most 100", float, lambda x: 0 < x <= 100)
whole = _value("a whole number, 0 or greater", int, lambda x: x >= 0)
positive = _value("a whole number, at least 1", int, lambda x: x >= 1)
workers = _value(
    "a whole number, at least 1, or tcp://HOST:PORT",
    lambda text: text if "://" in text else positive(text),
)
at_least_two = _value("a whole number, at least 2", int, lambda x: x >= 2)
cutoff = _value(
    "a number greater than 0, or none", lambda text: 0.0 if text == "none" else above_zero(text)
)
seconds_or_none = _value("a number, or none", lambda text: text if text == "none" else finite(text))
list_of_values = _values(above_zero)
list_of_noises = _values(not_negative)
list_of_ratios = _values(_value("a number that is not 0", float, lambda x: 0 < abs(x) < INF))
list_of_names = _values(_value("a name", str, bool))


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """Settings of a fit that replace those of robot.toml and of the rules; None keeps these.

    Attributes:
        cutoff_hz: cut-off frequency of the position filter, Hz; 0 for no filter.
        decimation: samples per row of the fit.
        span: `motion`, samples from the first to the last motion, or `all`.
        edges: treatment of the ends by the filter, `smooth` or `matlab`.
        low_speed_percent: speed below which samples have zero weight, percent of the peak speed:
            one value for least squares and IV, or one for each.
        method: method whose `low_speed_percent` is used; None for the default of the recording.
        ramp_rows: length of the weight taper, rows.
        torque_lag_s: delay of the torque to be compensated, s, positive if late; `none` for no
            correction.
        gains: motors whose drive gains are identified, or `("all",)`.
        law: control law that another fit of the recording estimated (`Evidence.law`), with the same
            cut-off, decimation and time range.
    """

    cutoff_hz: Annotated[
        float | None,
        option(
            "cut-off frequency of the position filter, Hz, or none (default: 5 times the "
            "bandwidth)",
            "F",
            cutoff,
        ),
    ] = None
    decimation: int | None = None
    span: Span | None = None
    edges: "Edges | None" = None
    low_speed_percent: "float | LowSpeed | None" = None
    method: Literal["ols", "wls", "iv"] | None = None
    ramp_rows: float | None = None
    torque_lag_s: Annotated[
        float | Literal["none"] | None,
        option(
            "delay of the recorded torque to be compensated, s, positive if late, or none "
            "(default: estimated if the reference is recorded, else from effort_timing)",
            "S",
            seconds_or_none,
        ),
    ] = None

    gains: Annotated[
        tuple[str, ...] | None,
        option(
            "identify the drive gains of all motors, or of those named, from recordings with and "
            "without a weighed payload",
            "MOTOR,MOTOR",
            list_of_names,
            nargs="?",
            const=("all",),
        ),
    ] = None
    law: Any = None

    def over(self, others: "Overrides") -> "Overrides":
        """Return these settings; those that are None come from `others`."""
        return replace(
            others, **{name: value for name, value in vars(self).items() if value is not None}
        )


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """What a log of another program does not contain; None for what it contains.

    Attributes:
        effort_unit: unit of the efforts; `N m` or `N` at the joints, or at motors with a `ratio`.
        drive_gain: motor torque or force per unit of effort; without a `ratio` at the joint.
        ratio: motor rad (or m) per joint rad (or m), sign included.
        position_unit: unit of the positions.
        columns: names or numbers of the columns of a table, and its rate.
        topic: topic of a ROS 2 bag.
        overwrite: whether recording, description and map of the log may be replaced.
    """

    effort_unit: Annotated[
        tuple[str, ...] | None,
        option(
            "unit of the efforts: 'N m' or N at the joints (with --ratio at the motors), or A, mA, "
            "V, %%, ... of the motors",
            "UNIT",
            list_of_names,
        ),
    ] = None
    drive_gain: Annotated[
        tuple[float, ...] | None,
        option(
            "torque in N m (or force in N) per unit of effort: of the motor, or without --ratio at "
            "the joint",
            "K",
            list_of_values,
        ),
    ] = None
    ratio: Annotated[
        tuple[float, ...] | None,
        option("motor rad (or m) per joint rad (or m), sign included", "R", list_of_ratios),
    ] = None
    position_unit: Annotated[
        tuple[str, ...] | None,
        option(
            "unit of the positions, rad, deg, m or mm; of the joints unless names say motor",
            "UNIT",
            list_of_names,
        ),
    ] = None
    columns: Annotated[
        str | None,
        option(
            "columns of a table by name or number, and rate=HZ if it has no times",
            "position=2-7,effort=8-13",
            str,
        ),
    ] = None
    topic: Annotated[
        str | None, option("topic of a ROS 2 bag (default: the only one)", "NAME", str)
    ] = None
    overwrite: Annotated[
        bool, option("make the recording of the log, its description and map anew")
    ] = False


@dataclass(frozen=True, kw_only=True)
class CellOptions:
    """Noise of a simulated recording; none by default.

    Attributes:
        encoder_step: step of the encoder, rad or m.
        position: noise of the encoder, rad or m rms.
        effort_percent: white noise of the recorded torque, percent of each joint's rms torque.
        coloured_percent: coloured noise, AR(0.98), of the recorded torque, percent of each joint's
            rms torque.
        lag_samples: delay of the recorded torque, samples.
    """

    encoder_step: Annotated[float, option("encoder step, rad or m", "Q", not_negative)] = 0.0
    position: Annotated[
        float, option("encoder noise, rad or m rms", "Q", not_negative, "--position-noise")
    ] = 0.0
    effort_percent: Annotated[
        float,
        option(
            "white noise of the recorded torque, %% of the rms torque",
            "P",
            not_negative,
            "--effort-noise-percent",
        ),
    ] = 0.0
    coloured_percent: Annotated[
        float,
        option(
            "coloured noise, AR(0.98), of the recorded torque, %% of the rms torque",
            "P",
            not_negative,
            "--effort-coloured-percent",
        ),
    ] = 0.0
    lag_samples: Annotated[int, option("delay of the recorded torque, samples", "K", whole)] = 0


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """Simulated recordings of a study, or, without `runs`, a single one.

    Attributes:
        runs: number of recordings.
        duration_s: length of a recording, s.
        sample_rate_hz: sample rate, Hz.
        seed: seed of the random references and of the noise.
    """

    runs: Annotated[int, option("number of runs", "N", positive)] = 20
    duration_s: Annotated[float, option("length of a recording, s", "S", above_zero)] = 10.0
    sample_rate_hz: Annotated[float, option("sample rate, Hz", "F", rate, "--rate-hz")] = 1000.0
    seed: Annotated[int, option("seed of the random reference and noise", "K", whole)] = 0


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions:
    """A periodic exciting reference, a Fourier series.

    Attributes:
        period_s: period, s.
        harmonics: number of harmonics, at least 2.
        periods: number of periods.
        seed: seed of the random search.
        limits_percent: share of each limit that may be used, percent.
    """

    period_s: Annotated[
        float, option("period of the Fourier series, s", "S", above_zero, "--period")
    ] = 10.0
    harmonics: Annotated[int, option("number of harmonics", "H", at_least_two)] = 10
    periods: Annotated[int, option("number of periods", "N", positive)] = 3
    seed: Annotated[int, option("seed of the random search", "K", whole)] = 1
    limits_percent: Annotated[
        float, option("share of each limit that may be used, %%", "P", percent)
    ] = 80.0
