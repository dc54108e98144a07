"""The JSON files of a fit and of a validation, each written and read by one type.

Independent of the methods, so that reading a file does not load them.
"""

import math
import re
from os import PathLike
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType

from acquisition.errors import BadInputError, Location
from acquisition.files import NAMES, kind_of, read_bytes

from .document import FORMAT, Document, ResultFile, Section
from .parameters import (
    AboveZero,
    ConsistentFile,
    Covariance,
    DriveGain,
    LawFile,
    LeftOut,
    Parameter,
    PayloadOfFit,
    PhysicalWarning,
    StandardParameter,
)
from .records import Records, Shown

Method = Literal["ols", "wls", "iv"]
Status = Literal["solved", "converged", "not_confirmed", "max_iterations", "diverged"]
Verdict = Literal["trust", "caution", "do not use"]
Level = Literal["do not use", "caution", "inconclusive", "skipped", "ok"]

# Of tests, levels and assumptions in files of earlier versions, the words of this one.
NEW_WORDS = {
    "fixed point": "convergence",
    "added columns": "missing terms",
    "held-out blocks": "cross-validation",
    "position noise": "noise bias",
    "halves": "first against second half",
    "gains": "drive gains",
    "lag": "delay",
    "physical": "physical plausibility",
    "prior": "a priori links",
    "consistent": "physically consistent",
    "ends": "outliers",
    "own parameters": "per-recording parameters",
    "ratios": "gear ratios",
    "lengths": "link lengths",
    "zeros": "joint zeros",
    "rotors": "rotor inertias",
    "cannot tell": "inconclusive",
    "not made": "skipped",
}
_OLD_WORD = re.compile(rb'("(?:test|level|what)"\s*:\s*)"([^"]*)"')
NO_FIXED_POINT: tuple[Status, ...] = ("max_iterations", "diverged")


class TorqueResidual(msgspec.Struct, frozen=True, kw_only=True):
    """Relative torque error 100 |Y - W beta| / |Y| in percent, and the unit of the torque.

    It is computed in the rows in which the joint moves, as in a fit, without weights, after filters
    that depend on the motion only, whatever those of the fit are. It is None without such rows or
    torque. The key with `moving` is the same. Rows at standstill are the others: no fit has them.
    `autocorrelation` is that of the residual at one row, `residual_rms` its rms in the unit.
    """

    name: str = ""
    relative_error_percent: float | None = None
    moving_relative_error_percent: float | None = None
    standing_relative_error_percent: float | None = None
    moving_rows: int = 0
    standing_rows: int = 0
    autocorrelation: float | None = None
    residual_rms: float | UnsetType = UNSET
    unit: str | UnsetType = UNSET


class FTest(msgspec.Struct, frozen=True, kw_only=True):
    """An F test of leaving out parameters, or of sharing per-recording ones; `names` lists them.

    The parameters left out are all but the essential ones, and those with an interval wider than
    the value. A small p rejects the hypothesis. The effective values are corrected for the
    residual's correlation.
    """

    names: tuple[str, ...]
    F: float | None
    p_value: float | None
    F_effective: float | None
    p_effective: float | None


class KnownLagFile(msgspec.Struct, frozen=True, kw_only=True):
    """The delay of a torque as known without a fit."""

    value_s: float
    sd_s: float | None = None  # missing in a file of an earlier version
    source: str


class LagFile(msgspec.Struct, frozen=True, kw_only=True):
    """The delay of a recording's torque, s, positive if late.

    The fit corrects the delay, and includes it in its intervals.
    """

    value_s: float
    half_width_s: float
    source: str
    prior: KnownLagFile
    effort_timing: str = "unknown"
    effort_object: str = ""
    effort_provenance: str = ""  # of a file of an earlier version, in place of the object


class Assumed(msgspec.Struct, frozen=True):
    """An assumption: its value, and why no test confirms it."""

    what: str
    value: str
    why: str


class Cause(msgspec.Struct, frozen=True, omit_defaults=True):
    """A mistake that a test names.

    Attributes:
        kind: `effort`, `position` or `backwards` for a sign, `efforts`, `positions` or `channels`
            for two that are swapped, `zero`, `degrees`, `unit`, `side` or `gravity`.
        of: joints, motors or the axis.
        figure: its size, deg or a factor; None for a sign or an order.
    """

    kind: str
    of: tuple[str, ...] = ()
    figure: float | None = None


class TrustResult(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One test of a fit.

    Attributes:
        test: its name, such as `convergence`.
        level: `skipped` if the test could not be made, `inconclusive` if it cannot decide.
        value: its figure, None if there is none; `expected`: the figure to compare it with.
        text: what was found, with the figure and its consequence.
        advice: what to do, an imperative; empty if there is nothing to do.
        finding: the same in a few words, for the first line of a report.
        figures: by joint, motor or block its name, value, half-width of the 95 % interval, and
            expected value, for a plot, in `unit`.
        case: which of its cases in the table of words holds.
        assumed: what the test cannot check; a file has all assumptions in one place.
        causes: the mistakes that the text names.

    A file of an earlier version has the first four alone, with the advice in the text.
    """

    test: str
    level: Level
    value: float | None
    text: str
    advice: str = ""
    expected: float | None = None
    finding: str = ""
    figures: tuple[tuple[str, float | None, float | None, float | None], ...] = ()
    unit: str = ""
    case: str = ""
    assumed: tuple[Assumed, ...] = ()
    causes: tuple[Cause, ...] = ()


class PassFile(msgspec.Struct, frozen=True, kw_only=True):
    """An iteration of the instrumental variable method."""

    instruments: str
    reason: str | None
    residual_norm: float
    largest_change_sigma: float | None
    largest_change_percent: float | None
    changed_most: str
    gains: list[float | None]
    tracking_error_percent: float | None
    condition_number_ztw: float | None
    settled: bool


class DirectModelResidual(msgspec.Struct, frozen=True, kw_only=True):
    """Relative errors of a simulated joint.

    The errors are of |q - mean|, None if the joint is held, and of |tau|.
    """

    name: str
    position_error_percent: float | None
    torque_error_percent: float | None


def versions() -> dict[str, str]:
    """Return the versions, by package, of this program and of those that its numbers depend on."""
    from importlib.metadata import version

    return {name: version(name) for name in ("robot-idim", "numpy", "scipy", "pin")}


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """The origin of a result: the recording by name and digest, the robot, the versions."""

    recording: str
    sha256: str
    robot: str
    versions: dict[str, str]


class RecordingOfFit(msgspec.Struct, frozen=True, kw_only=True):
    """One of several recordings of a fit or a validation.

    `held_out_error_percent` is that of the fit of the others; null where these leave the parameters
    `undetermined`, and in a validation.
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
    remarks: list[str] = msgspec.field(default_factory=list)  # recorder, payload


class OnRecording(ResultFile, frozen=True, kw_only=True):
    """The keys common to a fit and a validation.

    They are the torque errors of all joints and of each, the filters of these errors, settings, and
    warnings. A file of an earlier version has no `all_joints`, and none of the last four keys.
    """

    warnings: list[str] = msgspec.field(default_factory=list)
    relative_error_percent: float | None = None
    moving_relative_error_percent: float | None = None
    standing_relative_error_percent: float | None = None
    joints: list[TorqueResidual] = msgspec.field(default_factory=list)
    all_joints: TorqueResidual | None = None
    sample_rate_hz: AboveZero | None = None
    off_grid_periods: float = 0.0
    cutoff_hz: AboveZero | None = None
    cutoff_forward_backward_3db_hz: float | None = None
    decimation: Annotated[int, msgspec.Meta(ge=1)] | None = None
    error_cutoff_hz: AboveZero | None = None
    error_decimation: Annotated[int, msgspec.Meta(ge=1)] | None = None
    edges: Literal["smooth", "matlab"] | None = None
    low_speed_percent: dict[Literal["ls", "iv"], float | None] | None = None
    ramp_rows: float | None = None
    torque_lag_s: float | None = None
    span: str = ""
    span_rule: Literal["motion", "all"] | None = None
    samples: tuple[int, int] | None = None
    provenance: Provenance | None = None
    recordings: list[RecordingOfFit] | UnsetType = UNSET
    recorded_samples: int | None = None
    inputs: list[str] = msgspec.field(default_factory=list)  # known torque, feed-forward
    remarks: list[str] = msgspec.field(default_factory=list)  # recorder, payload

    @property
    def errors(self) -> Records[TorqueResidual]:
        """Torque errors of the joints and, last, of all together."""
        return Records(
            (
                *self.joints,
                self.all_joints
                or TorqueResidual(
                    name="all",
                    relative_error_percent=self.moving_relative_error_percent,
                    moving_rows=sum(joint.moving_rows for joint in self.joints),
                    standing_rows=sum(joint.standing_rows for joint in self.joints),
                ),
            ),
            "Torque errors",
            {
                "name": "",
                "unit": "",
                "relative_error_percent": ".4f",
                "standing_relative_error_percent": ".4f",
                "moving_rows": "d",
                "standing_rows": "d",
                "autocorrelation": ".2f",
                "residual_rms": None,
            },
        )


class FitFile(OnRecording, frozen=True, kw_only=True):
    """The JSON file of a fit, or of known values, with parameters only.

    Files of earlier versions have no verdict and no covariance. `left_out` are the base parameters
    that `--essential` leaves out; `consistent` and `standard_parameters` are those of
    `--consistent`. The keys from `reason` on are those of instrumental variables. An earlier file
    lacks those from `least_squares` on: least squares of a fit by instrumental variables, and its
    error if the iterations do not converge; the smallest eigenvalue of the Cragg–Donald statistic
    with drive gains; rows before those without weight; parameters whose interval is wider than the
    value. `corrected` says what `--write-corrected` changed in the description.
    """

    parameters: list[Parameter]
    method: Method | UnsetType = UNSET
    status: Status | UnsetType = UNSET
    doubts: list[PhysicalWarning] = msgspec.field(default_factory=list)
    condition_number: float | UnsetType | None = UNSET
    condition_number_scaled: float | UnsetType | None = UNSET
    rows: int | UnsetType = UNSET
    essential: FTest | UnsetType = UNSET
    description: dict[str, str] = msgspec.field(default_factory=dict)
    covariance: Covariance | UnsetType = UNSET
    left_out: list[LeftOut] | UnsetType = UNSET
    consistent: ConsistentFile | UnsetType = UNSET
    standard_parameters: list[StandardParameter] | UnsetType = UNSET
    verdict: Verdict | UnsetType = UNSET
    method_reason: str | UnsetType = UNSET
    assumed: list[Assumed] | UnsetType = UNSET
    lag: LagFile | UnsetType = UNSET
    trust: list[TrustResult] | UnsetType = UNSET
    held_out_error_percent: float | UnsetType | None = UNSET
    prior_source: str | UnsetType = UNSET
    prior_held_out_error_percent: float | UnsetType | None = UNSET
    own_parameters: FTest | UnsetType = UNSET
    gains: list[DriveGain] | UnsetType = UNSET
    payloads: list[PayloadOfFit] | UnsetType = UNSET
    law: LawFile | UnsetType = UNSET
    reason: str | UnsetType | None = UNSET
    pass_returned: int | UnsetType = UNSET
    start: str | UnsetType = UNSET
    reference: str | UnsetType = UNSET
    controller: str | UnsetType = UNSET
    iterations: list[PassFile] | UnsetType = UNSET
    instrument_tests: dict[str, float | None] | UnsetType = UNSET
    contrast_half_widths: float | UnsetType | None = UNSET
    contrast_parameter: str = ""
    rows_used_percent: float | UnsetType = UNSET
    saturated_percent: float | UnsetType | None = UNSET
    direct_model: list[DirectModelResidual] | UnsetType = UNSET
    least_squares: list[Parameter] | UnsetType = UNSET
    least_squares_error_percent: float | UnsetType | None = UNSET
    cragg_donald: float | UnsetType = UNSET
    recorded_rows: int | None = None
    unclear: list[str] = msgspec.field(default_factory=list)
    notes: list[str] = msgspec.field(default_factory=list)
    corrected: list[str] | UnsetType = UNSET

    @property
    def size(self) -> int:
        """Number of parameters, including those left out."""
        return len(self.parameters) + len(self.left_out or ())

    @property
    def line_of(self) -> dict[str, TrustResult]:
        """The tests by name, worst first."""
        return {line.test: line for line in self.trust or ()}

    @property
    def fitted_error_percent(self) -> float | None:
        """The torque error of the fit in the rows of the cross-validation."""
        return getattr(self.line_of.get("cross-validation"), "expected", None)

    @property
    def summary(self) -> str:
        """The kind of fit in a line."""
        error = self.moving_relative_error_percent  # in files of earlier versions too
        if not self.verdict or self.provenance is None:
            return f"{self.size} parameters"
        names = ", ".join(one.recording for one in self.recordings or (self.provenance,))
        told = "nothing moves" if error is None else f"torque error {error:.3g} %"
        return (
            f"{self.provenance.robot}, {names}, {self.method}, {self.status}, verdict "
            f"{self.verdict}: {self.size} parameters, "
            f"{sum(p.essential for p in self.parameters)} essential, {told}"
        )

    def __repr__(self) -> str:
        return f"FitFile({self.summary})"

    def warnings_of(self, place: str) -> list[str]:
        """Return warnings with the file `place`.

        They are about a status other than convergence, and about physically impossible values.
        """
        unsettled = self.status in (*NO_FIXED_POINT, "not_confirmed")
        return [
            *([f"{place}: its status is {self.status}"] * unsettled),
            *(f"{place}: {doubt.text}" for doubt in self.doubts if doubt.severe),
        ]


class Ahead(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of the positions that the direct model predicts open loop, by joint, rad or m.

    These are the rms error from measured states, and the rms way moved until then.
    """

    error: list[float]
    way: list[float]


class ValidationFile(Shown, OnRecording, frozen=True, kw_only=True):
    """The JSON file of `validate`.

    It has the errors of the file `fit`, and of its physically consistent set, all joints last. It
    also shows how far the fit predicts the motion: `ahead`, by time in s.
    """

    fit: str
    ahead: dict[str, Ahead] = msgspec.field(default_factory=dict)
    consistent_errors: list[TorqueResidual] | UnsetType = UNSET

    @property
    def document(self) -> Document:
        """The torque errors as a report, with the warnings."""
        return self.errors.document.followed_by(Section(warnings=tuple(self.warnings)))


def read_fit(path: str | PathLike[str]) -> FitFile:
    """Read a fit's JSON file, or one of known values.

    Raises
    ------
    BadInputError : the file cannot be read, or is not a fit of this format.
    """
    content, place = read_bytes(Path(path)), Location(str(path))
    try:
        stored = msgspec.json.decode(
            _OLD_WORD.sub(
                lambda x: x[1] + f'"{NEW_WORDS.get(x[2].decode(), x[2].decode())}"'.encode(),
                content,
            ),
            type=FitFile,
        )
    except msgspec.MsgspecError as error:
        other = kind_of(Path(path)).replace("json", "")
        text = (
            f"is {NAMES[other]}"
            if other
            else f"not a fit: {error}".replace("JSON is malformed", "no JSON")
        )
        raise BadInputError(
            text,
            place=str(path),
            expected=f"a fit as `robot-identify fit {path if other == 'mcap' else 'LOG.mcap'} "
            "--json FIT.json` writes it",
        ) from error
    place.require(
        stored.format == FORMAT, "format", stored.format, f"{FORMAT}, read by this version"
    )
    place.require(
        all(math.isfinite(p.value) and p.sigma >= 0 and p.half >= 0 for p in stored.parameters),
        "parameters",
        expected="finite values, sigmas of at least 0, low not above high",
    )
    return stored
