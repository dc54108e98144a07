"""What the JSON files of a fit and of a validation say of recordings; the file of a validation."""

from typing import Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType

from .document import ResultFile

AboveZero = Annotated[float, msgspec.Meta(gt=0)]


class JointError(msgspec.Struct, frozen=True, kw_only=True):
    """Torque errors as of `estimation.TorqueError`, in percent, null where there are no such rows; the torque's unit."""

    name: str = ""
    relative_error_percent: float | None = None
    moving_relative_error_percent: float | None = None
    standing_relative_error_percent: float | None = None
    moving_rows: int = 0
    standing_rows: int = 0
    autocorrelation: float | None = None
    unit: str | UnsetType = UNSET

    @property
    def percent(self) -> float | None:
        """Of the rows that move, or else of all."""
        moving = self.moving_relative_error_percent
        return self.relative_error_percent if moving is None else moving


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """Where a result comes from: the recording by name and digest, the robot, the versions."""

    recording: str
    sha256: str
    robot: str
    versions: dict[str, str]


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


class OnRecording(ResultFile, frozen=True, kw_only=True):
    """What a fit and a validation have in common: torque errors, of all joints and one by one, settings, warnings."""

    warnings: list[str] = msgspec.field(default_factory=list)
    relative_error_percent: float | None = None
    moving_relative_error_percent: float | None = None
    standing_relative_error_percent: float | None = None
    joints: list[JointError] = msgspec.field(default_factory=list)
    sample_rate_hz: AboveZero | None = None
    off_grid_periods: float = 0.0
    cutoff_hz: AboveZero | None = None
    cutoff_forward_backward_3db_hz: float | None = None
    decimation: Annotated[int, msgspec.Meta(ge=1)] | None = None
    edges: Literal["smooth", "matlab"] | None = None
    low_speed_percent: dict[Literal["ls", "iv"], float | None] | None = None
    torque_lag_s: float | None = None
    span: str = ""
    span_rule: Literal["motion", "all"] | None = None
    samples: tuple[int, int] | None = None
    provenance: Provenance | None = None
    recordings: list[RecordingOfFit] | UnsetType = UNSET


class ValidationFile(OnRecording, frozen=True, kw_only=True):
    """The JSON file of `validate`: errors of a fit, by its file's name, and of its consistent set, that of all joints last."""

    fit: str
    consistent_errors: list[JointError] | UnsetType = UNSET
