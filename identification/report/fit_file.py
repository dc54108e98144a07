"""The JSON file of a fit: one type by which it is written and read.

Nothing here knows of the methods: who reads a file need not load what made it. Types of other rooms that go into a file go by
their attributes' names.
"""

import math
import tomllib
from pathlib import Path
from typing import Literal

import msgspec
from msgspec import UNSET, UnsetType

from ..errors import IdentificationError
from .document import FORMAT
from .recording_file import AboveZero, OnRecording

Method = Literal["ols", "wls", "iv"]
Status = Literal["solved", "converged", "not_confirmed", "max_iterations", "diverged"]
Verdict = Literal["trust", "caution", "do not use"]
Level = Literal["do not use", "caution", "cannot tell", "not made", "ok"]

NO_FIXED_POINT: tuple[Status, ...] = ("max_iterations", "diverged")
PER_INTERVAL = 1.96  # deviations in half a 95 % interval


class Parameter(msgspec.Struct, frozen=True, kw_only=True):
    """A parameter with its 95 % interval and its deviation `sigma` by the formula, 0 where the value is known exactly.

    `low`, `high` and `expression`, what it stands for, are None in a file of an earlier version.
    """

    name: str
    value: float
    low: float | None = None
    high: float | None = None
    unit: str
    expression: str | None = None
    sigma: float = 0.0
    sigma_hac: float | UnsetType | None = UNSET  # of a file of an earlier version
    sigma_percent: float | UnsetType | None = UNSET
    essential: bool = False

    @property
    def half(self) -> float:
        """Half the 95 % interval; without one, 1.96 deviations, the larger of the two."""
        if self.low is None or self.high is None:
            return PER_INTERVAL * max(self.sigma, self.sigma_hac or 0.0)
        return 0.5 * (self.high - self.low)

    @property
    def spread(self) -> float:
        """The deviation to judge by, of which 1.96 make half the interval."""
        return self.half / PER_INTERVAL


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
    """A parameter of the consistent set, from the prior where the recording says less.

    Base parameters have `move`, in half-widths of the fit; earlier files have none.
    """

    name: str
    value: float
    unit: str
    from_prior: bool
    half_width: float | UnsetType = UNSET
    move: float | UnsetType = UNSET


class ConsistentFile(msgspec.Struct, frozen=True, kw_only=True):
    """The consistent set: what was expected, how far it is from the estimate, its torque error beside the estimate's.

    That distance is chi², and the largest move in half-widths of a 95 % interval; the certificate is the Newton decrement.
    Files of earlier versions may have another weight of the prior.
    """

    prior: str
    prior_weight: AboveZero = 1.0
    chi2: float
    largest_move: float
    moved_most: str
    certificate: float
    relative_error_percent: float | None
    base_parameters: list[StandardParameter] | UnsetType = UNSET


class EssentialSet(msgspec.Struct, frozen=True, kw_only=True):
    """The parameters that the recording determines well, and the F tests of leaving out the others."""

    names: list[str]
    F: float | None
    p_value: float | None
    F_effective: float | None
    p_effective: float | None


class KnownLagFile(msgspec.Struct, frozen=True, kw_only=True):
    """What is known of a torque's lag without a fit, as `regression.KnownLag`."""

    value_s: float
    sd_s: float | None = None  # missing in a file of an earlier version
    source: str


class LagFile(msgspec.Struct, frozen=True, kw_only=True):
    """The lag of a recording's torque, s, positive where it is late, that a fit corrects and counts in its intervals.

    It is that of other recordings of the same timing, effort objects and rate too.
    """

    value_s: float
    half_width_s: float
    source: str
    prior: KnownLagFile
    effort_timing: str = "unknown"
    effort_provenance: str = ""


class TrustLineFile(msgspec.Struct, frozen=True, kw_only=True):
    """A test of the fit."""

    test: str
    level: Level
    value: float | None
    text: str


class Assumed(msgspec.Struct, frozen=True):
    """What was given and not tested: its value, and why no test sees it."""

    what: str
    value: str
    why: str


class OwnTest(msgspec.Struct, frozen=True, kw_only=True):
    """The F test of own parameters of recordings, `names`, against shared ones: a small p says that they differ.

    `F_effective` and `p_effective` count only as many independent rows as the residual's correlation leaves.
    """

    names: tuple[str, ...]
    F: float
    p_value: float
    F_effective: float
    p_effective: float


class PassFile(msgspec.Struct, frozen=True, kw_only=True):
    """A pass of the instrumental variable method."""

    instruments: Literal["simulated", "consistent", "reference"]
    reason: str | None
    residual_norm: float
    largest_change_sigma: float | None
    largest_change_percent: float | None
    changed_most: str
    gains: list[float | None]
    tracking_error_percent: float | None
    condition_number_ztw: float | None
    settled: bool


class DirectModelErrorFile(msgspec.Struct, frozen=True, kw_only=True):
    """A joint of the simulated robot against the recording, as `simulation.DirectModelError`."""

    name: str
    position_error_percent: float | None
    torque_error_percent: float | None


class FitFile(OnRecording, frozen=True, kw_only=True):
    """The JSON file of a fit, or of known values, which have parameters alone; earlier ones have no verdict and no covariance.

    `left_out` are the base parameters that `--essential` leaves out; `consistent` and `standard_parameters` are those of
    `--consistent`. The keys from `reason` on are those of instrumental variables.
    """

    parameters: list[Parameter]
    method: Method | UnsetType = UNSET
    status: Status | UnsetType = UNSET
    doubts: list[Doubt] = msgspec.field(default_factory=list)
    condition_number: float | UnsetType | None = UNSET
    condition_number_scaled: float | UnsetType | None = UNSET
    rows: int | UnsetType = UNSET
    essential: EssentialSet | UnsetType = UNSET
    description: dict[str, str] = msgspec.field(default_factory=dict)
    covariance: Covariance | UnsetType = UNSET
    left_out: list[LeftOut] | UnsetType = UNSET
    consistent: ConsistentFile | UnsetType = UNSET
    standard_parameters: list[StandardParameter] | UnsetType = UNSET
    verdict: Verdict | UnsetType = UNSET
    method_reason: str | UnsetType = UNSET
    assumed: list[Assumed] | UnsetType = UNSET
    lag: LagFile | UnsetType = UNSET
    trust: list[TrustLineFile] | UnsetType = UNSET
    held_out_error_percent: float | UnsetType | None = UNSET
    own_parameters: OwnTest | UnsetType = UNSET
    reason: str | UnsetType | None = UNSET
    pass_returned: int | UnsetType = UNSET
    start: str | UnsetType = UNSET
    reference: str | UnsetType = UNSET
    controller: str | UnsetType = UNSET
    iterations: list[PassFile] | UnsetType = UNSET
    instrument_tests: dict[str, float | None] | UnsetType = UNSET
    contrast_half_widths: float | UnsetType | None = UNSET
    rows_used_percent: float | UnsetType = UNSET
    saturated_percent: float | UnsetType | None = UNSET
    direct_model: list[DirectModelErrorFile] | UnsetType = UNSET

    def warnings_of(self, place: str) -> list[str]:
        """Warnings, each led by `place`, its file: a status without a fixed point, values that no robot has."""
        unsettled = self.status in (*NO_FIXED_POINT, "not_confirmed")
        status = [f"its status is {self.status}"] if unsettled else []
        return [f"{place}: {text}" for text in (*status, *(doubt.text for doubt in self.doubts if doubt.severe))]


def read_fit(path: Path) -> FitFile:
    """Read a fit's JSON file, or one of known values.

    Raises `IdentificationError`: where it cannot be read, or is no fit of this format; `place` is the file.
    """
    try:
        stored = msgspec.json.decode(path.read_bytes(), type=FitFile)
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


def frame_lines(a: FitFile, b: FitFile, labels: tuple[str, str]) -> list[str]:
    """Compares the link frames of two fits: no lines, or one that says that they differ.

    Equal names stand for different quantities then. `labels` name the two fits.
    """
    if not a.description or not b.description:
        return []
    frames = [_frames(fit.description, label) for fit, label in zip((a, b), labels, strict=True)]
    if frames[0] == frames[1]:
        return []
    kinds = ["a URDF" if isinstance(one, str) else "DH rows" for one in frames]
    which = "two different URDFs" if kinds[0] == "a URDF" else "two different DH rows"
    if kinds[0] != kinds[1]:
        which = f"{labels[0]} has {kinds[0]}, {labels[1]} {kinds[1]}"
    return [
        f"the link frames differ: {which}; parameters of links (XX to M) compare only where a link has the same frame in both"
    ]


def _frames(description: dict[str, str], place: str) -> str | list[object]:
    """What the link frames follow from: the URDF's text, or the DH rows."""
    if "robot.urdf" in description:
        return description["robot.urdf"]
    try:
        return [joint["dh"] for joint in tomllib.loads(description["robot.toml"])["joint"]]
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        expected = "the robot.toml that was fitted"
        raise IdentificationError(place=place, key="description", value=str(error), expected=expected) from error
