"""A fit's JSON file, or that of known values, read back."""

import math
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType

from acquisition.robot import Edges, EffortTiming, LowSpeed, Robot, robot_from_files

from ..arrays import Array
from ..data import Signals
from ..errors import IdentificationError
from ..estimation import TorqueError
from ..model import BaseParameters, InverseModel, base_parameters
from ..regression import KnownLag, Overrides, Settings, Span, base_name
from ..report import FORMAT
from ..trust import HeldOut, Verdict
from .comparison import Parameter, ParameterSet
from .fit import NO_FIXED_POINT, Fit


class Doubt(msgspec.Struct, frozen=True):
    """What of a fit no robot has, as files of every version have it; `severe` where chance does not explain it."""

    text: str
    severe: bool


class Covariance(msgspec.Struct, frozen=True, kw_only=True):
    """Covariance (b, b) of the parameters `names`: deviations of the intervals, correlations of the formula."""

    names: list[str]
    values: list[list[float]]


class LeftOut(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter that `--essential` leaves out, with its deviation by least squares of all parameters."""

    name: str
    sigma: float


class StandardParameter(msgspec.Struct, frozen=True):
    """A parameter of the consistent set, from the prior where the recording says less. Base parameters have `move`, in
    half-widths of the fit; earlier files have none.
    """

    name: str
    value: float
    unit: str
    from_prior: bool
    half_width: float | UnsetType = UNSET
    move: float | UnsetType = UNSET


class ConsistentFile(msgspec.Struct, frozen=True, kw_only=True):
    """The consistent set: what was expected, how far it is from the estimate (chi², the largest move in half-widths of a 95 %
    interval), its certificate (Newton decrement), its torque error beside the estimate's.
    """

    prior: str
    prior_weight: Annotated[float, msgspec.Meta(gt=0)]
    chi2: float
    largest_move: float
    moved_most: str
    certificate: float
    relative_error_percent: float | None
    base_parameters: list[StandardParameter] | UnsetType = UNSET


class StoredJoint(msgspec.Struct, frozen=True):
    """The torque error of a joint, as far as it is read back."""

    relative_error_percent: float | None = None
    moving_relative_error_percent: float | None = None
    autocorrelation: float | None = None

    @property
    def percent(self) -> float | None:
        """Of the rows that move, or else of all."""
        moving = self.moving_relative_error_percent
        return self.relative_error_percent if moving is None else moving


class RecordingOfFit(msgspec.Struct, frozen=True, kw_only=True):
    """One of several recordings of a fit or a validation.

    Torque errors in percent are of all rows and of moving rows. `held_out_error_percent` is that of the fit of the others; null
    where these do not determine the parameters `undetermined`, and in a validation.
    """

    recording: str
    sha256: str
    sample_rate_hz: float
    decimation: int
    samples: tuple[int, int]
    relative_error_percent: float | None
    moving_relative_error_percent: float | None
    held_out_error_percent: float | None = None
    undetermined: list[str] = msgspec.field(default_factory=list)


def recording_of_fit(
    signals: Signals, settings: Settings, errors: tuple[TorqueError, ...], held_out: HeldOut | None = None
) -> RecordingOfFit:
    """A recording as the JSON file of a fit has it."""
    return RecordingOfFit(
        recording=signals.recording,
        sha256=signals.sha256,
        sample_rate_hz=signals.sample_rate_hz,
        decimation=settings.decimation,
        samples=(settings.start, settings.stop),
        relative_error_percent=errors[-1].relative_error_percent,
        moving_relative_error_percent=errors[-1].moving_relative_error_percent,
        held_out_error_percent=held_out.error_percent if held_out else None,
        undetermined=list(held_out.undetermined) if held_out else [],
    )


class LagFile(msgspec.Struct, frozen=True, kw_only=True):
    """The lag of a recording's torque, s, positive where it is late, that a fit corrects and counts in its intervals.

    It is that of other recordings of the same timing, effort objects and rate too.
    """

    value_s: float
    half_width_s: float
    source: str
    prior: KnownLag
    effort_timing: EffortTiming = "unknown"
    effort_provenance: str = ""


class StoredFit(msgspec.Struct, frozen=True):
    """The JSON file of a fit, or of known values, as far as it is read back."""

    parameters: list[Parameter]
    format: int = FORMAT
    method: str = "known"
    status: str = "known"
    doubts: list[Doubt] = msgspec.field(default_factory=list)
    joints: list[StoredJoint] = msgspec.field(default_factory=list)
    description: dict[str, str] = msgspec.field(default_factory=dict)
    covariance: Covariance | UnsetType = UNSET
    left_out: list[LeftOut] | UnsetType = UNSET
    consistent: ConsistentFile | UnsetType = UNSET
    standard_parameters: list[StandardParameter] | UnsetType = UNSET
    verdict: Verdict | UnsetType = UNSET
    sample_rate_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    cutoff_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    decimation: Annotated[int, msgspec.Meta(ge=1)] | None = None
    span_rule: Span | None = None
    edges: Edges | None = None
    torque_lag_s: float | None = None
    low_speed_percent: LowSpeed | None = None
    lag: LagFile | UnsetType = UNSET

    def settings(self, signals: Signals) -> Overrides:
        """The settings that the fit was made with, for another recording; known values have none.

        The lag is the fit's where timing, effort objects and rate are those of its recording; else what is known of it.
        """
        if self.sample_rate_hz is None:
            return Overrides()
        rate_hz = signals.sample_rate_hz
        n_d = self.decimation and max(1, round(self.decimation * rate_hz / self.sample_rate_hz))
        lag_s: float | Literal["none"] | None = "none" if self.torque_lag_s is None else self.torque_lag_s
        if self.lag is not UNSET:
            like = (self.lag.effort_timing, self.lag.effort_provenance, self.sample_rate_hz)
            lag_s = self.lag.value_s if like == (signals.effort_timing, signals.provenance, rate_hz) else None
        return Overrides(
            cutoff_hz=self.cutoff_hz or 0.0,
            decimation=n_d,
            span=self.span_rule,
            edges=self.edges,
            low_speed_percent=self.low_speed_percent,
            torque_lag_s=lag_s,
        )

    def robot(self, place: str) -> Robot | None:
        """The robot as the fit's own description has it; None where the file holds none."""
        return (
            robot_from_files({k: v.encode() for k, v in self.description.items()}, place) if self.description else None
        )

    def _values(self) -> dict[str, float]:
        """Values of base parameters; of those that recordings have for themselves, the mean."""
        given: dict[str, list[float]] = {}
        for p in self.parameters:
            given.setdefault(base_name(p.name), []).append(p.value)
        return {name: sum(values) / len(values) for name, values in given.items()}

    def parameter_set(self, label: str) -> ParameterSet:
        """The parameters under a label, such as the file's name."""
        return ParameterSet(label=label, parameters={p.name: p for p in self.parameters})

    def other_meaning(self, base: BaseParameters) -> list[str]:
        """Parameters that `base` does not have, or has in another unit or for another sum of standard parameters."""
        known = dict(zip(base.names, zip(base.units, base.expressions, strict=True), strict=True))
        return [
            p.name
            for p in self.parameters
            if (name := base_name(p.name)) not in known
            or p.unit != known[name][0]
            or p.expression not in (None, known[name][1])
        ]

    def consistent_fit(self, place: str) -> "StoredFit":
        """The same with the values of its consistent set; a file, `place`, without one is refused."""
        robot, given = self.robot(place), {p.name: p.value for p in self.standard_parameters or ()}
        if robot is None or not given:
            raise IdentificationError(place=place, key="standard_parameters", value=None, expected="`fit --consistent`")
        base = base_parameters(model := InverseModel(robot))
        beta = (base.K @ [given.get(name, 0.0) for name in model.names]).tolist()
        found = zip(base.names, beta, base.units, base.expressions, strict=True)
        parameters = [Parameter(name=n, value=x, unit=unit, expression=e) for n, x, unit, e in found]
        return msgspec.structs.replace(self, parameters=parameters)

    def beta(self, base: BaseParameters, place: str) -> Array:
        """(b,) values in the order of `base`, zero for those the fit left out; refuses a fit of another robot."""
        values = self._values()
        foreign = [name for name in values if name not in base.names]
        if foreign or not values:
            raise IdentificationError(
                place=place,
                key="parameters",
                value=", ".join(foreign[:5]) or None,
                expected=f"those of the recording's robot: {', '.join(base.names[:5])}, ...",
            )
        units = {base_name(p.name): p.unit for p in self.parameters}
        for name, unit in zip(base.names, base.units, strict=True):
            if units.get(name, unit) != unit:
                raise IdentificationError(
                    place=place,
                    key=f"{name}.unit",
                    value=units[name],
                    expected=f"{unit}, as the recording's robot has it",
                )
        return np.array([values.get(name, 0.0) for name in base.names])


def consistent_keys(fit: Fit) -> dict[str, Any]:
    """The keys `covariance` and `left_out` of any fit, `consistent` and `standard_parameters` of one made consistent."""
    full, names = fit.least_squares.full, fit.estimate.names
    sigma = dict(zip(full.names, full.covariance.diagonal() ** 0.5, strict=True))
    keys: dict[str, Any] = {
        "covariance": Covariance(names=list(names), values=fit.intervals.covariance.tolist()),
        "left_out": [LeftOut(name=n, sigma=float(sigma[n])) for n in full.names if n not in names],
    }
    c = fit.consistent
    if c is None:
        return keys
    standard = map(StandardParameter, c.names, c.chi.tolist(), c.units, c.from_prior.tolist(), c.half.tolist())
    of_base = (c.base_names, c.beta.tolist(), fit.base.units, c.base_from_prior.tolist(), c.base_half.tolist())
    return keys | {
        "consistent": ConsistentFile(
            prior=c.prior,
            prior_weight=c.prior_weight,
            chi2=c.chi_squared,
            largest_move=c.largest_move,
            moved_most=c.moved_most,
            certificate=c.certificate,
            relative_error_percent=fit.consistent_errors[-1].relative_error_percent,
            base_parameters=list(map(StandardParameter, *of_base, c.moves.tolist())),
        ),
        "standard_parameters": list(standard),
    }


def doubts(stored: StoredFit, place: str) -> list[str]:
    """Warnings about a stored fit, each led by `place`, its file: a status without a fixed point, values that no robot has."""
    unsettled = stored.status in (*NO_FIXED_POINT, "not_confirmed")
    status = [f"its status is {stored.status}"] if unsettled else []
    return [f"{place}: {text}" for text in (*status, *(doubt.text for doubt in stored.doubts if doubt.severe))]


def read_fit(path: Path) -> StoredFit:
    """Read a fit's JSON file, or one of known values.

    Raises `IdentificationError`: where it cannot be read, or is no fit of this format; `place` is the file.
    """
    try:
        stored = msgspec.json.decode(path.read_bytes(), type=StoredFit)
    except OSError as error:
        raise IdentificationError(f"cannot be read: {error.strerror}", place=str(path)) from error
    except msgspec.MsgspecError as error:
        raise IdentificationError(
            f"not a fit: {error}", place=str(path), expected="a fit as `robot-identify fit --json` writes it"
        ) from error
    if stored.format != FORMAT:
        raise IdentificationError(
            place=str(path), key="format", value=stored.format, expected=f"{FORMAT}, the one that this version reads"
        )
    if not all(math.isfinite(p.value) and p.sigma >= 0 and p.half >= 0 for p in stored.parameters):
        raise IdentificationError(
            place=str(path), key="parameters", expected="finite values, sigmas of at least 0, low not above high"
        )
    return stored


def frame_lines(a: StoredFit, b: StoredFit, labels: tuple[str, str]) -> list[str]:
    """Compares the link frames of two fits: no lines, or one that says that they differ.

    Equal names stand for different quantities then. `labels` name the two fits.
    """
    robots = [fit.robot(label) for fit, label in zip((a, b), labels, strict=True)]
    if any(robot is None for robot in robots):
        return []
    kinds = ["a URDF" if robot and robot.urdf is not None else "DH rows" for robot in robots]
    frames = [(robot.urdf, tuple(joint.dh for joint in robot.joints)) for robot in robots if robot]
    if frames[0] == frames[1]:
        return []
    which = "two different URDFs" if kinds[0] == "a URDF" else "two different DH rows"
    if kinds[0] != kinds[1]:
        which = f"{labels[0]} has {kinds[0]}, {labels[1]} {kinds[1]}"
    return [
        f"the link frames differ: {which}; parameters of links (XX to M) compare only where a link has the same frame in both"
    ]
