"""Memory that long recordings take, as the largest anonymous memory of a process: pages of files
are given back when others need them.

Run with `pytest tests/benchmarks/test_memory.py -s --benchmark-enable`; it takes some 3 minutes.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import REPLAY
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

BOUND_MB, BAG_MB, JOINTS = 400, 300, 6
STORE, STATE = get_typestore(Stores.ROS2_JAZZY), "sensor_msgs/msg/JointState"


def largest_mb(module: str, *words: object) -> float:
    """Largest anonymous memory of a command, sampled every 10 ms."""
    command = [sys.executable, "-m", module, *map(str, words)]
    process, found = subprocess.Popen(command), [0.0]
    while process.poll() is None:
        text = Path(f"/proc/{process.pid}/status").read_text()
        found += [float(x.split()[1]) / 1024 for x in text.splitlines() if "RssAnon" in x]
        time.sleep(0.01)
    assert process.returncode == 0
    return max(found)


def joint_states(path: Path, size_mb: float) -> int:
    """A bag of six joints at 1 kHz, with some jitter; returns its states."""
    rng, types, count = np.random.default_rng(0), STORE.types, 0
    header, stamp = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    names, w = [f"joint_{i + 1}" for i in range(JOINTS)], 1.2 + 0.3 * np.arange(JOINTS)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        states, (file,) = bag.add_connection("/s", STATE, typestore=STORE), path.glob("*.mcap")
        while file.stat().st_size < 1e6 * size_mb:
            for k in range(count, count + 1000):
                t, ns = 1e-3 * k, 10**18 + 10**6 * k + int(rng.integers(20_000))
                effort = np.sin(2 * w * t) + 0.01 * rng.standard_normal(JOINTS)
                at = header(stamp(*divmod(ns, 10**9)), "")
                one = types[STATE](at, names, np.sin(w * t), w * np.cos(w * t), effort)
                bag.write(states, ns, STORE.serialize_cdr(one, STATE))
            count += 1000
    return count


def robot_toml(path: Path) -> Path:
    text = 'name = "six"\n[controller]\nbandwidth_hz = 5.0\n'
    for i in range(JOINTS):
        text += f'[[joint]]\nname = "joint_{i + 1}"\ntype = "revolute"\nrotor_inertia = false\n'
        text += "dh = { alpha_deg = 0, d_m = 0.1, theta_deg = 0, r_m = 0 }\n"
        text += f'[[motor]]\nname = "motor_{i + 1}"\neffort_unit = "N m"\n'
    path.write_text(text)
    return path


def test_bag_import_of_300_mb(tmp_path):
    found = []
    for size_mb in (1, BAG_MB):
        bag, out = tmp_path / f"{size_mb}", tmp_path / f"{size_mb}.mcap"
        count = joint_states(bag, size_mb)
        robot = ("--robot", robot_toml(tmp_path / "robot.toml"))
        topic = ("--topic", "/s", "--effort-unit", "N m")
        found.append(largest_mb("acquisition", "import", bag, *robot, *topic, "-o", out))
    told = f"{found[1]:.0f} MB (bound {BOUND_MB}); of a bag of 1 MB {found[0]:.0f} MB"
    print(f"\nimport of a bag of {BAG_MB} MB, {count} states of six joints: {told}")
    assert found[1] < BOUND_MB


@pytest.mark.parametrize("hours", [0.7, 1])
def test_one_hour_of_simulated_recording(tmp_path, hours):
    """Also somewhat less, where single arrays are not yet large."""
    noise = ("--position-noise", 1e-6, "--effort-noise-percent", 3)
    noise += ("--effort-coloured-percent", 2)
    robot, found = REPLAY / "tx40" / "robot.toml", []
    for duration_s in (2, 3600 * hours):
        length = ("--duration-s", duration_s, "--rate-hz", 500, "--overwrite")
        out = tmp_path / "a.mcap"
        found.append(largest_mb("identification", "simulate", robot, *length, *noise, "-o", out))
    told = f"{found[1]:.0f} MB (bound {BOUND_MB}); of 2 s {found[0]:.0f} MB"
    print(f"\nsimulation of {hours:g} h of six joints at 500 Hz: {told}")
    assert found[1] < BOUND_MB
