"""A recording of a fleet, or those of a folder, and their fit as one row, and the task that makes it."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

import msgspec

from acquisition.errors import AcquisitionError

from ..data import RecordingFile, Recordings, versions
from ..errors import IdentificationError
from ..methods import Fit, fitted_parameters, identify
from ..regression import Overrides
from ..report import Method


@dataclass(frozen=True, kw_only=True)
class FleetSettings:
    """What all recordings of a fleet are fitted with.

    Attributes:
        method: of the fits.
        overrides: settings in place of those of the descriptions.
        description: content of the files of a description in place of the recordings' own, by name; None for their own.
    """

    method: Method = "wls"
    overrides: Overrides = field(default_factory=Overrides)
    description: tuple[tuple[str, bytes], ...] | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of the settings and of the versions: rows made with others are made anew."""
        made_with = (self.method, self.overrides, self.description, sorted(versions().items()))
        return hashlib.sha256(repr(made_with).encode()).hexdigest()


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter with the ends of its 95 % interval, SI."""

    value: float
    low: float | None
    high: float | None
    unit: str


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """A recording and its fit, or recordings that are fitted together.

    Attributes:
        folder: of the fleet that the recording was found under; `file` its path, or the folder of several.
        sha256: `digest_of` the files, empty where one cannot be read.
        start: when the recording began, None where nothing says so.
        robot: its name, empty where the recording cannot be read.
        status: of the fit, `failed` or `copy`; `reason` says why there is no fit.
        verdict: of the fit, empty without one.
        error_percent, moving_error_percent, standing_error_percent: relative torque errors of all rows, of those of moving
            joints and of the others.
        parameters: by name, empty without a fit.
    """

    folder: str
    file: str
    sha256: str = ""
    start: datetime | None = None
    robot: str = ""
    method: Method
    status: str
    verdict: str = ""
    reason: str = ""
    error_percent: float | None = None
    moving_error_percent: float | None = None
    standing_error_percent: float | None = None
    parameters: dict[str, Value] = {}

    @property
    def is_fitted(self) -> bool:
        """Whether the row has an estimate."""
        return bool(self.parameters)


def digest_of(digests: Sequence[str]) -> str:
    """The digest of a recording, or one of several recordings in whatever order."""
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(sorted(digests)).encode()).hexdigest()


def fit_row(sources: tuple[RecordingFile, ...], settings: FleetSettings, row: Row) -> Row | None:
    """Fit a recording, or several of one robot together.

    Returns the row of the fit, or the reason why there is none; None where this process does not find a file.
    """
    if not all(source.found for source in sources):
        return None
    try:
        loaded = tuple(source.load() for source in sources)
        began = [signals.began for signals in loaded if signals.began is not None]
        row = msgspec.structs.replace(row, robot=loaded[0].robot.name, start=min(began, default=None))
        if digest_of([signals.sha256 for signals in loaded]) != row.sha256:
            expected = "a finished recording"
            raise IdentificationError("has changed since the run began", place=row.file, expected=expected)
        given = loaded[0] if len(loaded) == 1 else Recordings(sources=loaded)
        return _fitted(row, identify(given, settings.overrides, method=settings.method))
    except (AcquisitionError, IdentificationError, OSError, MemoryError) as error:
        reason = str(error) or type(error).__name__
    except Exception as error:  # one recording that shows a mistake of this program must not end a run of days
        reason = f"unexpected {type(error).__name__}: {error}"
    return msgspec.structs.replace(row, status="failed", reason=reason.replace("\n", " "))


def _fitted(row: Row, fit: Fit) -> Row:
    whole = fit.errors[-1]
    return msgspec.structs.replace(
        row,
        status=fit.status,
        verdict=fit.trust.verdict,
        reason=(fit.iv.reason or "") if fit.iv else "",
        error_percent=whole.relative_error_percent,
        moving_error_percent=whole.moving_relative_error_percent,
        standing_error_percent=whole.standing_relative_error_percent,
        parameters={
            name: Value(value=p.value, low=p.low, high=p.high, unit=p.unit)
            for name, p in fitted_parameters(fit).parameters.items()
        },
    )
