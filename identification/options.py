"""What users choose, each with its default, unit and help at its field; and their values: text in, a number in its range out.

The rooms use these records, the commands make options of them (`acquisition.options`). Nothing heavy is imported here.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from acquisition.options import option

if TYPE_CHECKING:
    from acquisition.robot import Edges, LowSpeed

INF = float("inf")
Span = Literal["motion", "all"]
Controllers = Literal["described", "none"]


def _value(
    name: str, read: Callable[[str], Any], accepts: Callable[[Any], bool] = lambda found: True
) -> Callable[[str], Any]:
    """A function that reads a value, `ValueError` where it is not accepted; argparse shows `name` in its error."""

    def value(text: str) -> Any:
        found = read(text)
        if not accepts(found):
            raise ValueError(text)
        return found

    value.__name__ = name
    return value


def _values(name: str, read: Callable[[str], Any]) -> Callable[[str], Any]:
    """The same for values separated by commas."""
    return _value(name, lambda text: tuple(read(part.strip()) for part in text.split(",")))


finite = _value("finite", float, lambda x: -INF < x < INF)
above_zero = _value("above_zero", float, lambda x: 0 < x < INF)
not_negative = _value("not_negative", lambda text: float(text) + 0.0, lambda x: 0 <= x < INF)  # -0 is 0
share = _value("share", float, lambda x: 0 <= x < 100)  # percent
percent = _value("percent", float, lambda x: 0 < x <= 100)
whole = _value("whole", int, lambda x: x >= 0)
positive = _value("positive", int, lambda x: x >= 1)
at_least_two = _value("at_least_two", int, lambda x: x >= 2)
cutoff = _value("cutoff", lambda text: 0.0 if text == "none" else above_zero(text))
seconds_or_none = _value("seconds_or_none", lambda text: text if text == "none" else finite(text))
list_of_cutoffs = _values("cutoffs", cutoff)
list_of_factors = _values("factors", above_zero)
list_of_controllers = _values("controllers", _value("controller", str, ("described", "none").__contains__))
list_of_values = _values("values", above_zero)
list_of_names = _values("names", _value("name", str, bool))


@dataclass(frozen=True, kw_only=True)
class Overrides:
    """Options of a fit that take the place of the rules; None leaves the rule (or robot.toml) in force.

    `cutoff_hz` 0 means no filter; one number for `low_speed_percent` holds for least squares and for iv; `torque_lag_s` "none"
    corrects nothing.
    """

    cutoff_hz: Annotated[
        float | None, option("low-pass of the position, Hz, or none (default: 5 times the bandwidth)", "F", cutoff)
    ] = None
    decimation: Annotated[int | None, option("samples per decimated row", "N", positive, "--decimate")] = None
    span: Annotated[
        Span | None,
        option(
            "also use the standstill before and after the motion",
            flag="--all-samples",
            action="store_const",
            const="all",
        ),
    ] = None
    edges: "Edges | None" = None
    low_speed_percent: Annotated[
        "float | LowSpeed | None",
        option(
            "leave out rows slower than P %% of the peak speed (default: 4, or 4 deviations of the speed's noise)",
            "P",
            share,
        ),
    ] = None
    torque_lag_s: Annotated[
        float | Literal["none"] | None,
        option(
            "known lag of the recorded torque, s, positive where it is late: corrected (default: half a period early for a "
            "held command), or none",
            "S",
            seconds_or_none,
        ),
    ] = None

    def over(self, others: "Overrides") -> "Overrides":
        """These, and those of the others where these are silent."""
        return replace(others, **{name: value for name, value in vars(self).items() if value is not None})


@dataclass(frozen=True, kw_only=True)
class IterationOptions:
    """Where the instrumental variable method starts, and where it ends."""

    start: Annotated[
        str,
        option(
            "first parameters: unit inertias (default), least squares, or those of a fit's JSON file",
            "regular|ls|FIT.json",
        ),
    ] = "regular"
    tolerance_percent: Annotated[float, option("passes end when changes are smaller", "P", above_zero)] = 2.5
    max_iterations: Annotated[int, option("most passes", "N", positive)] = 10


@dataclass(frozen=True, kw_only=True)
class CellOptions:
    """Imperfections of a simulated cell, none by default. Percent are of each joint's rms torque, where not said otherwise."""

    encoder_step: Annotated[float, option("step of the encoder, rad or m", "Q", not_negative)] = 0.0
    position: Annotated[float, option("noise of the encoder, rad or m rms", "Q", not_negative, "--position-noise")] = (
        0.0
    )
    effort_percent: Annotated[
        float, option("white noise of the torque, %% of its rms", "P", not_negative, "--effort-noise-percent")
    ] = 0.0
    coloured_percent: Annotated[
        float, option("AR(0.98) noise of the torque, %% of its rms", "P", not_negative, "--effort-coloured-percent")
    ] = 0.0
    disturbance_percent: Annotated[float, option("AR(0.98) torque that acts, %% of the rms", "P", not_negative)] = 0.0
    recorded: Annotated[
        Literal["mean", "tick"],
        option(
            "torque as the mean of the periods before and after, or the command of its tick", flag="--effort-recorded"
        ),
    ] = "mean"
    lag_samples: Annotated[int, option("samples by which the recorded torque is late", "K", whole)] = 0
    stribeck_percent: Annotated[float, option("more Coulomb friction at rest, %% of itself", "P", not_negative)] = 0.0
    asymmetry_percent: Annotated[
        float, option("friction larger forwards, smaller backwards, %% of itself", "P", share)
    ] = 0.0
    integral_hz: Annotated[float, option("rate of an integral of the controller, 0 for none", "F", not_negative)] = 0.0


@dataclass(frozen=True, kw_only=True)
class StudyOptions:
    """What a study varies: each run draws one of each list, seeded by its number; and the recordings that it simulates."""

    runs: Annotated[int, option("number of runs", "N", positive)] = 100
    cutoffs: Annotated[tuple[float, ...], option("cut-offs, times the bandwidth", "A,B,none", list_of_cutoffs)] = (
        5.0,
        10.0,
        0.0,
    )
    starts: Annotated[tuple[float, ...], option("first inertias, times the true ones", "A,B", list_of_factors)] = (
        0.05,
        1.0,
        20.0,
    )
    gain_errors: Annotated[tuple[float, ...], option("gains, times the true ones", "A,B", list_of_factors)] = (
        0.7,
        1.0,
        1.3,
    )
    controllers: Annotated[
        tuple[Controllers, ...],
        option("described, or none: the fit is not given the control law", "A,B", list_of_controllers),
    ] = ("described",)
    vary: Annotated[
        Literal["listed", "everything"],
        option("everything: each run draws imperfections of the cell and a controller as well"),
    ] = "listed"
    duration_s: Annotated[float, option("length", "S", above_zero)] = 10.0
    period_s: Annotated[
        float, option("about the period of the reference; whole periods make up the length", "S", above_zero)
    ] = 10.0
    sample_rate_hz: Annotated[float, option("sample rate", "F", above_zero, "--rate-hz")] = 1000.0
    low_speed_percent: Annotated[float | None, option("as for fit", "P", share)] = None
    seed: Annotated[int, option("seed of reference and noise", "K", whole)] = 0


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions:
    """What an exciting reference is to be: a Fourier series that is repeated."""

    period_s: Annotated[float, option("of the Fourier series, s", "S", above_zero, "--period")] = 10.0
    harmonics: Annotated[int, option("of the series", "H", at_least_two)] = 10
    periods: Annotated[int, option("how often it is repeated", "N", positive)] = 3
    seed: Annotated[int, option("of the searches' starts", "K", whole)] = 1
    limits_percent: Annotated[float, option("share of all limits that it may use", "P", percent)] = 80.0
