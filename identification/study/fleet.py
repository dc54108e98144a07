"""Fleets: which recordings there are, the row of each and its fit, and which rows of earlier runs still hold."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Literal

import msgspec

from acquisition.errors import AcquisitionError
from acquisition.files import atomic_write
from acquisition.recording import has_reference

from ..data import RecordingFile, Recordings, Work, WorkersNotStartedError, versions
from ..errors import IdentificationError
from ..methods import Fit, fitted_parameters, identify
from ..regression import Overrides
from ..report import Method

Say = Callable[[int, str], None]
OpenWork = Callable[[int], AbstractContextManager[Work]]
NOT_FOUND = "{}: a worker does not find it: expected a folder that all workers read at the same path"


@dataclass(frozen=True, kw_only=True)
class FleetSettings:
    """What all recordings of a fleet are fitted with; `description` as that of a `RecordingFile`."""

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
        sha256: `digest_of` the files; empty where one cannot be read, as is the name of the robot.
        start: when the recording began, None where nothing says so.
        status: of the fit, `failed` or `copy`; `reason` says why there is no fit.
        error_percent, moving_error_percent, standing_error_percent: relative torque errors of all rows, of those of moving
            joints and of the others.
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
        return _fitted(row, identify(Recordings(sources=loaded), settings.overrides, method=settings.method))
    except (AcquisitionError, IdentificationError, OSError, MemoryError) as error:
        reason = str(error) or type(error).__name__
    except Exception as error:  # one recording that shows a mistake of this program must not end a run of days
        reason = f"unexpected {type(error).__name__}: {error}"
    return _failed(row, reason.replace("\n", " "))


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


Task = tuple[tuple[RecordingFile, ...], FleetSettings, Row]


def found_recordings(folders: Sequence[Path], *, by_folder: bool = False) -> list[tuple[Path, Path]]:
    """Every `*.mcap` under the folders, by name, with the one of `folders` that it was first found under.

    `by_folder`: every folder that has some, for recordings that lie in one folder then make one fit. An `IdentificationError`
    where one is not a folder, or none holds a recording.
    """
    found: dict[Path, tuple[Path, Path]] = {}
    for folder in folders:
        if not folder.is_dir():
            raise IdentificationError("is no folder", place=str(folder), expected="a folder of recordings, *.mcap")
        for path in sorted(path for path in folder.rglob("*.mcap") if _is_recording(path)):
            fitted = path.parent if by_folder else path
            found.setdefault(fitted.resolve(), (folder, fitted))
    if not found:
        expected = "files *.mcap in the folders or below them"
        raise IdentificationError("no recordings", place=", ".join(map(str, folders)), expected=expected)
    return list(found.values())


def method_of(recordings: Sequence[Path]) -> Literal["iv", "wls"]:
    """The method of a whole table: instrumental variables where every recording, or all of every folder, has its reference."""
    files = [file for path in recordings for file in (path.glob("*.mcap") if path.is_dir() else [path])]
    return "iv" if all(has_reference(file) for file in files if _is_recording(file)) else "wls"


def _is_recording(path: Path) -> bool:
    return path.is_file() and not path.name.startswith(".")  # those are being written


def run_fleet(
    recordings: Sequence[tuple[Path, Path]], settings: FleetSettings, kept: Path, open_work: OpenWork, say: Say
) -> list[Row]:
    """One fit per recording, or per folder of recordings.

    Returns a row per path, in the order of their start; those without one last. A recording that cannot be fitted has a
    row with the reason, and so has one with the same content as another. Raises `AcquisitionError`: where a row cannot
    be kept. Raises `WorkersNotStartedError`: where no worker can start.
    """
    digest = settings.digest[:16]

    def file_of(row: Row) -> Path:
        return kept / f"{row.sha256[:32]}-{digest}.json"

    rows: list[Row] = []
    first: dict[str, str] = {}  # file with that digest
    tasks: list[Task] = []
    for folder, path in recordings:
        files = sorted(filter(_is_recording, path.glob("*.mcap"))) if path.is_dir() else [path]
        row = _begun(Row(folder=str(folder), file=str(path), method=settings.method, status="open"), files)
        if row.sha256 in first:
            row = msgspec.structs.replace(row, status="copy", reason=f"holds the same as {first[row.sha256]}")
        elif row.sha256:
            first[row.sha256] = row.file
            earlier = _earlier(file_of(row), row)
            if earlier is None:
                sources = (RecordingFile(path=str(file.absolute()), description=settings.description) for file in files)
                tasks.append((tuple(sources), settings, row))
                continue
            row = earlier
        rows.append(row)
    say(len(rows), "kept from earlier runs")
    for row, lasting in _fits(tasks, open_work):
        if lasting:
            with atomic_write(file_of(row)) as partial:
                partial.write_bytes(msgspec.json.format(msgspec.json.encode(row), indent=1))
        rows.append(row)
        say(len(rows), row.file)
    return sorted(rows, key=lambda row: (row.start is None, row.start.timestamp() if row.start else 0.0, row.file))


def _earlier(path: Path, recording: Row) -> Row | None:
    """The row of a recording that was fitted with the same settings, wherever it lay; None where there is none."""
    try:
        row = msgspec.json.decode(path.read_bytes(), type=Row)
    except (OSError, msgspec.DecodeError):  # a file of another version, or a damaged one: fitted again
        return None
    if row.sha256 != recording.sha256:
        return None
    return msgspec.structs.replace(row, folder=recording.folder, file=recording.file)


def _begun(row: Row, files: Sequence[Path]) -> Row:
    """What is known of recordings from their bytes; one that cannot be read has failed."""
    digests = []
    for path in files:
        try:
            with path.open("rb") as file:
                digests.append(hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            return _failed(row, f"{path}: cannot be read: {error.strerror or error}")
    return msgspec.structs.replace(row, sha256=digest_of(digests))


def _fits(tasks: Sequence[Task], open_work: OpenWork) -> Iterator[tuple[Row, bool]]:
    """The rows of the fits, and whether each is what the recording gives: not where its workers died.

    Where workers are lost, the first task that was not done is tried again alone, and the others go on with new workers.
    """
    alone = False
    while tasks:
        given, done = tasks[:1] if alone else tasks, 0
        with open_work(max(2, len(given))) as work:  # one alone is not done in this process, which would end with it
            try:
                for result in work.run(fit_row, given):
                    yield result or _failed(tasks[done][2], NOT_FOUND.format(tasks[done][2].file)), result is not None
                    done += 1
            except WorkersNotStartedError:
                raise
            except IdentificationError as error:  # tasks do not raise: workers are lost
                if alone:
                    yield _failed(tasks[0][2], str(error)), False
                    done = 1
        alone = not alone and done < len(given)
        tasks = tasks[done:]


def _failed(row: Row, reason: str) -> Row:
    return msgspec.structs.replace(row, status="failed", reason=reason)
