"""Writes ROS 2 bags of CDR channels."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..arrays import Array
from ..errors import AcquisitionError
from ..recording import JOINT_STATE, TEXT, RosMessages

_BAG_VERSION = 8  # of rosbag2's metadata; the oldest one that the package rosbags writes


class BagWriter:
    """Adds messages to the open `writer` of a bag."""

    def __init__(self, writer: Any) -> None:
        self._writer, self._messages = writer, RosMessages()
        self._channels: dict[str, Any] = {}

    def joint_state(self, topic: str, stamp_ns: int, names: list[str], values: tuple[Array, Array, Array]) -> None:
        """Write a JointState of position, velocity, effort (n,) each, or empty."""
        self._write(topic, JOINT_STATE, stamp_ns, self._messages.joint_state(stamp_ns, names, *values))

    def text(self, topic: str, stamp_ns: int, text: str) -> None:
        """Write a String that subscribers get however late they come."""
        self._write(topic, TEXT, stamp_ns, self._messages.text(text))

    def _write(self, topic: str, kind: str, stamp_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.add_connection(
                topic, kind, typestore=self._messages.store, offered_qos_profiles=[_latched()] if kind == TEXT else []
            )
        self._writer.write(self._channels[topic], stamp_ns, data)


@contextmanager
def new_bag(folder: Path) -> Iterator[BagWriter]:
    """Write a ROS 2 bag, a folder with an .mcap of CDR channels, whole or not at all."""
    from rosbags.rosbag2 import StoragePlugin, Writer

    if not folder.name or os.path.lexists(folder):
        raise AcquisitionError("already exists", place=str(folder), expected="the name of a new folder")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        partial.mkdir()
        # The file inside has the folder's name: the folder has its own name from the beginning.
        writer = Writer(partial / folder.name, version=_BAG_VERSION, storage_plugin=StoragePlugin.MCAP)
        writer.open()
        try:
            yield BagWriter(writer)
        except BaseException:
            writer.abort()
            raise
        writer.close()
        (partial / folder.name).rename(folder)
    except OSError as error:
        raise AcquisitionError(f"cannot be written: {error.strerror or error}", place=str(folder)) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)


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
