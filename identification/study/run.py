"""The run over a fleet: which recordings there are, which rows are kept from earlier runs, and the fits of the others."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec

from acquisition.files import atomic_write
from acquisition.recording import has_reference

from ..data import RecordingFile, Work, WorkersNotStartedError
from ..errors import IdentificationError
from .rows import FleetSettings, Row, digest_of, fit_row

Say = Callable[[int, str], None]
Task = tuple[tuple[RecordingFile, ...], FleetSettings, Row]
OpenWork = Callable[[int], AbstractContextManager[Work]]


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Rows kept as one file per recording in a folder, by the digests of the recording and of the settings."""

    folder: Path
    settings: str

    def _path(self, sha256: str) -> Path:
        return self.folder / f"{sha256[:32]}-{self.settings[:16]}.json"

    def row(self, recording: Row) -> Row | None:
        """The row of a recording that was fitted with the same settings, wherever it lay; None where there is none."""
        try:
            row = msgspec.json.decode(self._path(recording.sha256).read_bytes(), type=Row)
        except (OSError, msgspec.DecodeError):  # a file of another version, or a damaged one: fitted again
            return None
        if row.sha256 != recording.sha256:
            return None
        return msgspec.structs.replace(row, folder=recording.folder, file=recording.file)

    def keep(self, row: Row) -> None:
        """Keep a row. Raises `AcquisitionError` where its file cannot be written."""
        with atomic_write(self._path(row.sha256)) as partial:
            partial.write_bytes(msgspec.json.format(msgspec.json.encode(row), indent=1))


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
    store = Kept(folder=kept, settings=settings.digest)
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
            earlier = store.row(row)
            if earlier is None:
                sources = (RecordingFile(path=str(file.absolute()), description=settings.description) for file in files)
                tasks.append((tuple(sources), settings, row))
                continue
            row = earlier
        rows.append(row)
    say(len(rows), "kept from earlier runs")
    for row, lasting in _fits(tasks, open_work):
        if lasting:
            store.keep(row)
        rows.append(row)
        say(len(rows), row.file)
    return sorted(rows, key=lambda row: (row.start is None, row.start.timestamp() if row.start else 0.0, row.file))


def _begun(row: Row, files: Sequence[Path]) -> Row:
    """What is known of recordings from their bytes; one that cannot be read has failed."""
    digests = []
    for path in files:
        try:
            with path.open("rb") as file:
                digests.append(hashlib.file_digest(file, "sha256").hexdigest())
        except OSError as error:
            reason = f"{path}: cannot be read: {error.strerror or error}"
            return msgspec.structs.replace(row, status="failed", reason=reason)
    return msgspec.structs.replace(row, sha256=digest_of(digests))


def _fits(tasks: Sequence[Task], open_work: OpenWork) -> Iterator[tuple[Row, bool]]:
    """The rows of the fits, and whether each is what the recording gives: not where its workers died.

    Where workers are lost, the first task that was not done is tried again alone, and the others go on with new workers.
    """
    while tasks:
        with open_work(max(2, len(tasks))) as work:  # one alone is not done in this process, which would end with it
            results, done = work.run(fit_row, tasks), 0
            try:
                for result in results:
                    yield _lasting(result, tasks[done])
                    done += 1
            except IdentificationError as error:  # tasks do not raise: workers are lost
                if isinstance(error, WorkersNotStartedError):
                    raise
        if done < len(tasks):
            yield _alone(tasks[done], open_work)
            done += 1
        tasks = tasks[done:]


def _lasting(result: Row | None, task: Task) -> tuple[Row, bool]:
    """The row of a task, and whether it is kept: not that of a recording which the worker does not find."""
    if result is None:
        reason = f"{task[2].file}: a worker does not find it: expected a folder that all workers read at the same path"
        return msgspec.structs.replace(task[2], status="failed", reason=reason), False
    return result, True


def _alone(task: Task, open_work: OpenWork) -> tuple[Row, bool]:
    with open_work(2) as work:
        try:
            (result,) = work.run(fit_row, [task])
            return _lasting(result, task)
        except IdentificationError as error:
            if isinstance(error, WorkersNotStartedError):
                raise
            return msgspec.structs.replace(task[2], status="failed", reason=str(error)), False
