"""Options of users, each with its default, unit and help; and the functions that read
and check their values.

Rooms use these records, commands make options from them (`acquisition.options`). No heavy imports.
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
    """Return a function that reads a value; argparse shows what was `expected` if it is not
    accepted.
    """

    def value(text: str) -> Any:
        with suppress(ValueError, ArgumentTypeError):
            if accepts(found := read(text)):
                return found
        raise ArgumentTypeError(f"{text!r}: expected {expected}")

    return value


def _values(read: Callable[[str], Any]) -> Callable[[str], Any]:
    """Return a function that reads values separated by commas."""
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
    """Settings of a fit that replace the rules; None keeps the rule, or the key of robot.toml.

    Attributes:
        cutoff_hz: low-pass of the position, Hz; 0 means no filter.
        low_speed_percent: one number is for least squares and iv; `method` takes its own, by the
            recording if it is None.
        ramp_rows: weight taper, as in `Settings`.
        torque_lag_s: delay of the torque, s; "none" means no correction.
        law: control law that another fit of the recording estimated, with the same cut-off,
            decimation
            and time range (`Evidence.law`).
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
        """Return these options; those that are None come from `others`."""
        return replace(
            others, **{name: value for name, value in vars(self).items() if value is not None}
        )


@dataclass(frozen=True, kw_only=True)
class CellOptions:
    """Noise of a simulated cell, none by default; of the torque in percent of
    each joint's rms torque.
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
    """Simulated recordings of a study; without `runs` also of a single one."""

    runs: Annotated[int, option("number of runs", "N", positive)] = 20
    duration_s: Annotated[float, option("length of a recording, s", "S", above_zero)] = 10.0
    sample_rate_hz: Annotated[float, option("sample rate, Hz", "F", rate, "--rate-hz")] = 1000.0
    seed: Annotated[int, option("seed of the random reference and noise", "K", whole)] = 0


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions:
    """An exciting reference: a Fourier series that is repeated."""

    period_s: Annotated[
        float, option("period of the Fourier series, s", "S", above_zero, "--period")
    ] = 10.0
    harmonics: Annotated[int, option("number of harmonics", "H", at_least_two)] = 10
    periods: Annotated[int, option("number of periods", "N", positive)] = 3
    seed: Annotated[int, option("seed of the random search", "K", whole)] = 1
    limits_percent: Annotated[
        float, option("share of each limit that may be used, %%", "P", percent)
    ] = 80.0
