"""Bags of ROS 2 with the states of trajectory controllers, in the versions of their message,
by the package rosbags.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

JOINT_STATE, CONTROLLER_STATE = (
    "sensor_msgs/msg/JointState",
    "control_msgs/msg/JointTrajectoryControllerState",
)
POINT, MULTI = (
    "trajectory_msgs/msg/JointTrajectoryPoint",
    "trajectory_msgs/msg/MultiDOFJointTrajectoryPoint",
)
CONTROLLER = "/joint_trajectory_controller/controller_state"
OLD, HUMBLE, JAZZY = "old", "humble", "jazzy"
PARTS = ("reference", "feedback", "error", "output")
POINTS = {OLD: ("desired", "actual", "error"), HUMBLE: (*PARTS, "desired", "actual"), JAZZY: PARTS}
MULTIPLE = {OLD: (), HUMBLE: POINTS[HUMBLE], JAZZY: PARTS}


def store_of(version: str) -> Typestore:
    lines = [
        "std_msgs/Header header",
        "string[] joint_names",
        *(f"{POINT} {name}" for name in POINTS[version]),
    ]
    if MULTIPLE[version]:
        lines += [
            "string[] multi_dof_joint_names",
            *(f"{MULTI} multi_dof_{name}" for name in MULTIPLE[version]),
        ]
    lines += ["float64 speed_scaling_factor"] * (version == JAZZY)
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("\n".join(lines), CONTROLLER_STATE))
    return store


STORES = {version: store_of(version) for version in (OLD, HUMBLE, JAZZY)}


def state(version: str, stamp_ns: int, names: Iterable[str], reference: np.ndarray) -> Any:
    """A state whose reference alone is right; all other points have other positions and speeds."""
    types = STORES[version].types
    names, none, no_time = list(names), np.zeros(0), types["builtin_interfaces/msg/Duration"](0, 0)
    other = types[POINT](reference + 9, reference + 5, none, none, no_time)
    points = [
        types[POINT](reference, reference + 3, none, none, no_time),
        *[other] * (len(POINTS[version]) - 1),
    ]
    header = types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9)), ""
    )
    multiple = [types[MULTI]([], [], [], no_time) for _ in MULTIPLE[version]]
    rest = [*[["base"]] * bool(multiple), *multiple, *[1.0] * (version == JAZZY)]
    return types[CONTROLLER_STATE](header, names, *points, *rest)


def controller_bag(
    path: Path,
    joint_states: Iterable[tuple[int, Any]],
    topics: Mapping[str, Iterable[tuple[int, Iterable[str], np.ndarray]]],
    version: str = HUMBLE,
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """Joint states by time, and for each topic of a controller times in ns, names, and
    references of them in rad.
    """
    store, late_ns = STORES[version], 2_000_000
    with Writer(path, version=9, storage_plugin=storage) as writer:
        states = writer.add_connection("/joint_states", JOINT_STATE, typestore=store)
        for stamp_ns, message in joint_states:
            writer.write(states, stamp_ns + late_ns, store.serialize_cdr(message, JOINT_STATE))
        for topic, rows in topics.items():
            controller = writer.add_connection(topic, CONTROLLER_STATE, typestore=store)
            for stamp_ns, names, reference in rows:
                message = state(version, stamp_ns, names, np.array(reference))
                writer.write(
                    controller, stamp_ns + late_ns, store.serialize_cdr(message, CONTROLLER_STATE)
                )
    return path
