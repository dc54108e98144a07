"""Recordings by where they are: files that are read by the process that needs them, or signals in memory."""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from acquisition.robot import Robot, robot_from_files

from .signals import Signals, load_signals
from .work import Serial, Work


@dataclass(frozen=True, kw_only=True)
class RecordingFile:
    """A recording's file, read by the process that needs it, at the same path in all of them.

    Attributes:
        path: of the file.
        description: content of the files of a description in place of the recording's own, by name; None for its own.
    """

    path: str
    description: tuple[tuple[str, bytes], ...] | None = None

    @classmethod
    def at(cls, path: Path, robot: Robot | None = None) -> "RecordingFile":
        """The recording at `path`, by the description `robot` where one is given."""
        return cls(path=str(path.absolute()), description=None if robot is None else tuple(robot.files.items()))

    @property
    def found(self) -> bool:
        """Whether this process can read it."""
        return Path(self.path).exists()

    def load(self) -> Signals:
        """The signals of the recording. Raises as `load_signals`."""
        robot = None if self.description is None else robot_from_files(dict(self.description), self.path)
        return load_signals(self.path, robot)

    @property
    def key(self) -> str:
        """What tells it from others in a cache."""
        described = hashlib.sha256(repr(self.description).encode()).hexdigest()
        return f"{self.path} {described}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Recordings:
    """Recordings of one robot that are fitted together, and where the work on them is done."""

    sources: tuple[Signals | RecordingFile, ...]
    work: Work = field(default_factory=Serial)
