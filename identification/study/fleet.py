"""Fleets: find recordings, fit each to a row, reuse stored rows of earlier runs."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from acquisition.errors import AcquisitionError
from acquisition.files import atomic_write
from acquisition.recording import has_reference

from ..data import RecordingFile, Recordings, Work
from ..errors import IdentificationError
from ..methods import Fit, fitted_parameters, identify
from ..regression import Overrides
from ..report import Method, versions

Say = Callable[[int, str], None]
WorkFor = Callable[[int], Work]
NOT_FOUND = "{}: not found by a worker: expected a folder that all workers read at the same path"


@dataclass(frozen=True, kw_only=True)
class FleetSettings:
    """Settings of all fits of a fleet; `description` as in `RecordingFile`."""

    method: Method = "wls"
    overrides: Overrides = field(default_factory=Overrides)
    description: tuple[tuple[str, bytes], ...] | None = None

    @property
    def digest(self) -> str:
        """SHA-256 of settings and package versions: rows with another digest are made again."""
        made_with = (self.method, self.overrides, self.description, sorted(versions().items()))
        return hashlib.sha256(repr(made_with).encode()).hexdigest()


class Value(msgspec.Struct, frozen=True, kw_only=True):
    """A base parameter with the ends of its 95 % interval, SI."""

    value: float
    low: float | None
    high: float | None
    unit: str


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """The fit of a recording, or of recordings fitted together.

    Attributes:
        folder: of the fleet in which the recording was found; `file` its path, or the folder of several.
        sha256: `digest_of` the files; empty if one cannot be read, like the robot's name.
        start: when the recording began, None if unknown.
        status: of the fit, `failed` or `copy`; `reason` says why there is no fit.
        error_percent, moving_error_percent, standing_error_percent: relative torque errors of all rows, of moving
            joints and of joints at rest.
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
    """The digest of a recording, or of several in any order."""
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(sorted(digests)).encode()).hexdigest()


def fit_row(sources: tuple[RecordingFile, ...], settings: FleetSettings, row: Row) -> Row | None:
    """Fit a recording, or several of one robot together.

    Returns the row, with a `reason` if the fit failed; None if this process does not find a file.
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
        return _fitted_row(row, identify(Recordings(sources=loaded), settings.overrides, method=settings.method))
    except (AcquisitionError, IdentificationError, OSError, MemoryError) as error:
        reason = str(error) or type(error).__name__
    except Exception as error:  # a bug that one recording triggers must not end a run of days
        reason = f"unexpected {type(error).__name__}: {error}"
    return _failed_row(row, reason.replace("\n", " "))


def _fitted_row(row: Row, fit: Fit) -> Row:
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


Task = tuple[tuple[RecordingFile, ...], FleetSettings, Row]


class FleetEntry(NamedTuple):
    """What one row is about: the folder of the fleet, the path of a recording or of a folder of some, the recordings."""

    folder: Path
    path: Path
    files: tuple[Path, ...]


def found_recordings(folders: Sequence[Path], *, by_folder: bool = False) -> list[FleetEntry]:
    """Every `*.mcap` under the folders, by name, with the first of `folders` that contains it.

    `by_folder`: one entry per folder that has recordings, which are fitted together. Raises `IdentificationError`: if one of
    `folders` is not a folder, or none holds a recording.
    """
    found: dict[Path, FleetEntry] = {}
    for folder in folders:
        if not folder.is_dir():
            raise IdentificationError("is not a folder", place=str(folder), expected="a folder of recordings, *.mcap")
        groups: dict[Path, list[Path]] = {}
        for file in sorted(folder.rglob("*.mcap")):
            if file.is_file() and not file.name.startswith("."):  # hidden ones are being written
                groups.setdefault(file.parent if by_folder else file, []).append(file)
        for path, files in groups.items():
            found.setdefault(path.resolve(), FleetEntry(folder, path, tuple(files)))
    if not found:
        expected = "files *.mcap in the folders or below them"
        raise IdentificationError("no recordings", place=", ".join(map(str, folders)), expected=expected)
    return list(found.values())


def method_of(entries: Sequence[FleetEntry]) -> Literal["iv", "wls"]:
    """The method of a whole table: instrumental variables if every recording has its reference."""
    return "iv" if all(has_reference(file) for entry in entries for file in entry.files) else "wls"


def run_fleet(
    entries: Sequence[FleetEntry], settings: FleetSettings, row_folder: Path, work_for: WorkFor, say: Say
) -> list[Row]:
    """One fit per recording, or per folder of recordings.

    Returns a row per path, ordered by start; those without a start come last. A recording that cannot be fitted, or has the
    same content as another, has a row with the reason. Raises `AcquisitionError`: if a row cannot be stored in `row_folder`.
    Raises `IdentificationError`: if a worker ends in mid-task.
    """
    digest = settings.digest[:16]

    def file_of(row: Row) -> Path:
        return row_folder / f"{row.sha256[:32]}-{digest}.json"

    rows: list[Row] = []
    first: dict[str, str] = {}  # file with that digest
    tasks: list[Task] = []
    for folder, path, files in entries:
        row = _initial_row(Row(folder=str(folder), file=str(path), method=settings.method, status="open"), files)
        if row.sha256 in first:
            row = msgspec.structs.replace(row, status="copy", reason=f"same content as {first[row.sha256]}")
        elif row.sha256:
            first[row.sha256] = row.file
            earlier = _stored_row(file_of(row), row)
            if earlier is None:
                sources = (RecordingFile(path=str(file.absolute()), description=settings.description) for file in files)
                tasks.append((tuple(sources), settings, row))
                continue
            row = earlier
        rows.append(row)
    say(len(rows), "stored by earlier runs")
    results = work_for(len(tasks)).run(fit_row, tasks)
    for (_, _, initial), found in zip(tasks, results, strict=True):
        row = found or _failed_row(initial, NOT_FOUND.format(initial.file))
        if found is not None:
            with atomic_write(file_of(row)) as partial:
                partial.write_bytes(msgspec.json.format(msgspec.json.encode(row), indent=1))
        rows.append(row)
        say(len(rows), row.file)
    return sorted(rows, key=lambda row: (row.start is None, row.start.timestamp() if row.start else 0.0, row.file))


def _stored_row(path: Path, recording: Row) -> Row | None:
    """The stored row of a recording with this content, wherever its file was; None if there is none."""
    try:
        row = msgspec.json.decode(path.read_bytes(), type=Row)
    except (OSError, msgspec.DecodeError):  # of another version, or damaged: fit again
        return None
    if row.sha256 != recording.sha256:
        return None
    return msgspec.structs.replace(row, folder=recording.folder, file=recording.file)


def _initial_row(row: Row, files: Sequence[Path]) -> Row:
    """The row with the digest of the files; failed if one cannot be read."""
    digests = []
    for path in files:
        try:
            with path.open("rb") as file:
                digests.append(hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            return _failed_row(row, f"{path}: cannot be read: {error.strerror or error}")
    return msgspec.structs.replace(row, sha256=digest_of(digests))


def _failed_row(row: Row, reason: str) -> Row:
    return msgspec.structs.replace(row, status="failed", reason=reason)
