"""Recordings by where they are: files that are read by the process that needs them, or signals in memory."""

import hashlib
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

from acquisition.robot import Robot, robot_from_files

from ..errors import IdentificationError
from .signals import Signals, load_signals
from .work import Serial, Work


@dataclass(frozen=True, kw_only=True)
class RecordingFile:
    """A recording's file, read where it is needed.

    Attributes:
        path: of the file.
        description: content of the files of a description in place of the recording's own, by name; None for its own.
        content: of the file itself, for a process that cannot open the path.
    """

    path: str
    description: tuple[tuple[str, bytes], ...] | None = None
    content: bytes | None = None

    @classmethod
    def at(cls, path: Path, robot: Robot | None = None) -> "RecordingFile":
        """The recording at `path`, by the description `robot` where one is given."""
        return cls(path=str(path.absolute()), description=None if robot is None else tuple(robot.files.items()))

    @property
    def found(self) -> bool:
        """Whether this process can read it."""
        return self.content is not None or Path(self.path).exists()

    def with_content(self) -> "RecordingFile":
        """The same with the file's content, to be sent to where the path does not lead to it."""
        try:
            return replace(self, content=Path(self.path).read_bytes())
        except OSError as error:
            raise IdentificationError(f"cannot be read: {error.strerror}", place=self.path) from error

    def load(self) -> Signals:
        """The signals of the recording. Raises as `load_signals`."""
        robot = None if self.description is None else robot_from_files(dict(self.description), self.path)
        if self.content is None:
            return load_signals(self.path, robot)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / Path(self.path).name
            path.write_bytes(self.content)
            return load_signals(path, robot)

    @property
    def key(self) -> str:
        """What tells it from others in a cache."""
        described = hashlib.sha256(repr(self.description).encode()).hexdigest()
        return f"{self.path} {described} {self.content is None}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recordings:
    """Recordings of one robot that are fitted together, and where the work on them is done."""

    sources: tuple[Signals | RecordingFile, ...]
    work: Work = field(default_factory=Serial)
