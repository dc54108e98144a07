"""From the log of another program and a URDF to the true values: one command each.

The arms are pinocchio's; the logs have the columns, names and units that their programs write.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from conftest import IDENTIFY
from controller_bags import CONTROLLER, HUMBLE, STORES, controller_bag
from pinocchio_arm import Arm, arm_of
from urdfs import packaged_urdf

import identification

RATE_HZ, SECONDS, SEED, FIRST_NS = 250.0, 12.0, 1, 1_700_000_000_000_000_000
UR5 = [
    f"{name}_joint"
    for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
PANDA = [f"panda_joint{j}" for j in range(1, 8)]
MOST_PERCENT = 1.0  # of the torque along a motion that no log has
GAINS = np.array([13.26, 13.13, 13.3, 9.1, 9.2, 9.3])  # joint torque per A


def table(path: str, names: list[str], columns: list[np.ndarray], separator: str = ",") -> None:
    header = separator.join(names)
    np.savetxt(path, np.column_stack(columns), "%.17g", separator, header=header, comments="")


def rtde(t, q, tau, q_ref) -> str:
    """UR's RTDE recorder: joints from 0, currents of the motors, other columns between."""
    speed, none = np.gradient(q, t, axis=0), 0 * q
    kinds = ("target_q", "target_qd", "actual_q", "actual_qd", "actual_current", "actual_TCP_pose")
    names = ["timestamp", *(f"{kind}_{j}" for kind in kinds for j in range(6))]
    table("log.csv", names, [1234.5 + t, q_ref, speed, q, speed, tau / GAINS, 0.3 + none], " ")
    return "log.csv"


def bag(t, q, tau, q_ref) -> str:
    """A driver and a trajectory controller of ROS 2; joints in the order of the alphabet."""
    types, order = STORES[HUMBLE].types, np.argsort(UR5)
    names, stamps = [UR5[j] for j in order], [FIRST_NS + round(x * 1e9) for x in t]

    def state(stamp_ns: int, *values: np.ndarray):
        stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
        header = types["std_msgs/msg/Header"](stamp, "")
        return types["sensor_msgs/msg/JointState"](header, names, *(x[order] for x in values))

    speed = np.gradient(q, t, axis=0)
    states = [(s, state(s, *row)) for s, *row in zip(stamps, q, speed, tau, strict=True)]
    controller = [(s, UR5, row) for s, row in zip(stamps, q_ref, strict=True)]
    controller_bag(Path("log"), states, {CONTROLLER: controller})
    return "log"


def plotjuggler(t, q, tau, q_ref) -> str:
    """PlotJuggler's export of joint states and of a controller's."""
    names = [
        f"/joint_states/{joint}/{kind}"
        for kind in ("position", "velocity", "effort")
        for joint in UR5
    ]
    table("log.csv", ["__time", *names], [1.7e9 + t, q, np.gradient(q, t, axis=0), tau])
    return "log.csv"


def no_header(t, q, tau, q_ref) -> str:
    table("log.txt", [], [t, q, tau], " ")
    Path("log.txt").write_text(Path("log.txt").read_text().lstrip("\n"))
    return "log.txt"


def mat(t, q, tau, q_ref) -> str:
    scipy.io.savemat("log.mat", {"t": t[:, None], "q": q.T, "qref": q_ref.T, "tau": tau.T})
    return "log.mat"


def libfranka(t, q, tau, q_ref) -> str:
    """libfranka's log: state and command, torques of sensors, times in ms."""
    kinds = {"q": q, "q_d": q_ref, "dq": np.gradient(q, t, axis=0), "tau_J": tau}
    names = ["time", *(f"state.{kind}[{j}]" for kind in kinds for j in range(7))]
    names += [f"cmd.tau_J_d[{j}]" for j in range(7)]
    table("log.csv", names, [np.rint(1000 * t), *kinds.values(), 9 + 0 * tau])
    return "log.csv"


LOGS = {
    "RTDE": ("ur5_robot", rtde, ["--drive-gain", ",".join(map(str, GAINS))]),
    "ROS 2 bag": ("ur5_robot", bag, ["--effort-unit", "N m"]),
    "PlotJuggler": ("ur5_robot", plotjuggler, ["--effort-unit", "N m"]),
    "no header": (
        "ur5_robot", no_header,
        ["--columns", "position=2-7,effort=8-13", "--position-unit", "rad", "--effort-unit", "N m"],
    ),
    "MAT": ("panda", mat, ["--position-unit", "rad", "--effort-unit", "N m"]),
    "libfranka": ("panda", libfranka, []),
}  # fmt: skip


@pytest.fixture
def logged(request, tmp_path, monkeypatch) -> tuple[Arm, str, list[str]]:
    """The arm whose URDF stands in the working folder; its log; the options that it needs."""
    name, write, options = LOGS[request.param]
    monkeypatch.chdir(tmp_path)
    shutil.copy(packaged_urdf(f"{name}.urdf"), "arm.urdf")
    truth = arm_of(Path("arm.urdf").read_text(), UR5 if name == "ur5_robot" else PANDA)
    if write is libfranka:
        truth = replace(truth, Ia=0 * truth.Ia)  # its sensors do not measure rotors
        q, tau = truth.measured(SEED, SECONDS, RATE_HZ)
        q_ref = truth.motion(SEED, SECONDS, RATE_HZ)[0]
    else:
        q, tau, q_ref = truth.driven(SEED, SECONDS, RATE_HZ)
    return truth, write(np.arange(len(q)) / RATE_HZ, q, tau, q_ref), options


@pytest.mark.parametrize("logged", LOGS, indirect=True)
def test_log_and_urdf_to_true_values(logged, capsys):
    truth, log, options = logged
    status = IDENTIFY.main(["fit", log, "arm.urdf", *options, "--json", "fit.json"])
    out, err = capsys.readouterr()
    print(out, err)
    assert status == 0, (out, err)
    fit = identification.read_fit("fit.json")
    print(truth.errors_percent(fit.predict))
    assert truth.errors_percent(fit.predict).max() < MOST_PERCENT
