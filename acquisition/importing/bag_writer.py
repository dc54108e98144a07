"""Writes ROS 2 bags of CDR channels."""

import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from ..arrays import Array
from ..errors import AcquisitionError
from ..recording import JOINT_STATE, TEXT, TRANSFORMS, RosMessages

_BAG_VERSION = 8  # of rosbag2's metadata; the oldest one that the package rosbags writes


class BagWriter:
    """Writes a ROS 2 bag, a folder with an .mcap of CDR channels, whole or not at all; a context manager."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if not folder.name or os.path.lexists(folder):
            raise AcquisitionError("already exists", place=str(folder), expected="the name of a new folder")
        self._partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
        self._messages = RosMessages()
        self._channels: dict[str, Any] = {}

    def __enter__(self) -> Self:
        from rosbags.rosbag2 import StoragePlugin, Writer

        try:
            self._partial.mkdir()
            # The file inside has the folder's name: the folder has its own name from the beginning.
            self._writer = Writer(
                self._partial / self._folder.name, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP
            )
            self._writer.open()
        except OSError as error:
            self._remove()
            raise self._failed(error) from error
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            if error is None:
                self._writer.close()
                (self._partial / self._folder.name).rename(self._folder)
            else:
                self._writer.abort()
        except OSError as failed:
            raise self._failed(failed) from failed
        finally:
            self._remove()
        if isinstance(error, OSError):
            raise self._failed(error) from error

    def joint_state(self, topic: str, stamp_ns: int, names: list[str], values: tuple[Array, Array, Array]) -> None:
        """Write a JointState of position, velocity, effort (n,) each, or empty."""
        self._write(topic, JOINT_STATE, stamp_ns, self._messages.joint_state(stamp_ns, names, *values))

    def transforms(
        self, topic: str, stamp_ns: int, frames: Sequence[tuple[str, str]], shift: Array, turn: Array
    ) -> None:
        """Write a TFMessage (`RosMessages.transforms`)."""
        self._write(topic, TRANSFORMS, stamp_ns, self._messages.transforms(stamp_ns, frames, shift, turn))

    def text(self, topic: str, stamp_ns: int, text: str) -> None:
        """Write a String that subscribers get however late they come."""
        self._write(topic, TEXT, stamp_ns, self._messages.text(text))

    def _write(self, topic: str, kind: str, stamp_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.add_connection(
                topic, kind, typestore=self._messages.store, offered_qos_profiles=[_latched()] if kind == TEXT else []
            )
        self._writer.write(self._channels[topic], stamp_ns, data)

    def _failed(self, error: OSError) -> AcquisitionError:
        return AcquisitionError(f"cannot be written: {error.strerror or error}", place=str(self._folder))

    def _remove(self) -> None:
        with suppress(OSError):
            shutil.rmtree(self._partial)


def _latched() -> Any:
    """Quality of service of a topic whose last message is kept for late subscribers."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
