"""ROS 2 bags of joint states as the package rosbags writes them."""

import numpy as np
from rosbags.rosbag2 import CompressionFormat, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
STATE, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/String"
N, RATE_HZ, FIRST_NS = 200, 100, 1_700_000_000_000_000_000
T = np.arange(N) / RATE_HZ
Q = np.stack([0.5 * np.sin(2 * T), 0.3 * np.sin(3 * T)], axis=1)
DQ = np.stack([np.cos(2 * T), 0.9 * np.cos(3 * T)], axis=1)
EFFORT = np.stack([np.cos(5 * T), 2 + np.sin(T)], axis=1)
NAMES = ("shoulder", "elbow")


def message(k, *, names=NAMES, frame="", stamp_ns=None, **parts):
    """The joint state k as rosbags has it; names in another order take the values with them."""
    types = STORE.types
    stamp_ns = FIRST_NS + k * 1_000_000_000 // RATE_HZ if stamp_ns is None else stamp_ns
    stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 1_000_000_000))
    values = {"position": Q, "velocity": DQ, "effort": EFFORT} | parts
    order = [NAMES.index(name) if name in NAMES else -1 for name in names]
    own = [
        np.zeros(0) if x is None else np.array([x[k][i] if i >= 0 else 9.0 for i in order])
        for x in values.values()
    ]
    return types[STATE](types["std_msgs/msg/Header"](stamp, frame), list(names), *own)


def bag(
    path,
    messages,
    *,
    storage=StoragePlugin.MCAP,
    compression=None,
    topic="/joint_states",
    late_ns=3_000_000,
):
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer as w:
        states = w.add_connection(topic, STATE, typestore=STORE)
        other = w.add_connection("/rosout", TEXT, typestore=STORE)
        text = STORE.types[TEXT]("hello")
        w.write(other, FIRST_NS, STORE.serialize_cdr(text, TEXT))
        for k, m in enumerate(messages):
            w.write(
                states,
                FIRST_NS + late_ns + k * 1_000_000_000 // RATE_HZ,
                STORE.serialize_cdr(m, STATE),
            )
    return path
