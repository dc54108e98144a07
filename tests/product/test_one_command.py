"""From the log of another program and a URDF to the true values: one command each.

The arms are pinocchio's; the logs have the columns, names and units that their programs write.
"""

import os
import pty
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from conftest import IDENTIFY, REPLAY
from controller_bags import CONTROLLER, HUMBLE, STORES, controller_bag
from pinocchio_arm import Arm, arm_of
from urdfs import packaged_urdf

import identification
from acquisition.errors import BadInputError
from acquisition.recording import read_recording
from acquisition.robot import load_robot
from identification.model import InverseModel

RATE_HZ, SECONDS, SEED, FIRST_NS = 250.0, 8.0, 1, 1_700_000_000_000_000_000
UR5 = [
    f"{name}_joint"
    for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
]
PANDA = [f"panda_joint{j}" for j in range(1, 8)]
MOST_PERCENT = 1.0  # of the torque along a motion that no log has
LEAST_INSIDE = 0.85  # share of true values in their 95 % intervals
SESSION = REPLAY / "scara" / "session.mcap"
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
    """Base parameters by pinocchio's arm are in their intervals, and predict unseen torques."""
    truth, log, options = logged
    assert IDENTIFY.main(["fit", log, "arm.urdf", *options, "--json", "fit.json"]) == 0
    out, err = capsys.readouterr()
    assert "assumed" not in out.partition("Verdict")[0]
    assert err == ""
    fit = identification.read_fit("fit.json")
    assert truth.errors_percent(fit.predict).max() < MOST_PERCENT
    rows = InverseModel(load_robot(Path("log.robot.toml"))).regressor(*truth.motion(2, 2.0, 50.0))
    rows = rows[:, :, fit.base.columns].reshape(-1, fit.base.b)
    true, *_ = np.linalg.lstsq(rows, truth.torque(*truth.motion(2, 2.0, 50.0)).ravel(), rcond=None)
    inside = [p.low <= x <= p.high for p, x in zip(fit.parameters, true, strict=True)]
    assert np.mean(inside) > LEAST_INSIDE


@pytest.mark.parametrize("logged", [name for name in LOGS if name != "libfranka"], indirect=True)
def test_nothing_is_guessed(logged, capsys):
    """Without a terminal each missing option is named, and nothing is written."""
    _, log, options = logged
    before, needed = sorted(Path().iterdir()), options[::2]
    status = IDENTIFY.main(["fit", log, "arm.urdf", "--method", "wls"])
    out, err = capsys.readouterr()
    if needed == ["--drive-gain"]:
        assert status == 3, "fitted in A: not to be used"
        assert "efforts in A\n" in out
        return
    assert (status, out, sorted(Path().iterdir())) == (1, "", before)
    assert err.count("\n") == 1
    named = {x.strip(",.()") for x in err.split() if "--" in x}
    assert named == {*needed}
    with pytest.raises(BadInputError, match=needed[-1].strip("-").replace("-", "_")):
        identification.fit_log(log, "arm.urdf")


ANSWERS = {  # those that are wrong are asked again
    "no header": ["2-7", "position=2-6", "position=2-7,effort=8-13", "Ncm", "Nm"],
    "RTDE": ["x", ",".join(map(str, GAINS))],
    "PlotJuggler": ["A", "1"],
}


@pytest.mark.parametrize("logged", ANSWERS, indirect=True)
def test_terminal_is_asked(logged, request):
    """A terminal answers at most two questions; what is assumed is said."""
    _, log, _ = logged
    name = request.node.callspec.params["logged"]
    arguments, (terminal, child) = ["fit", log, "arm.urdf", "--method", "wls"], pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "identification", *arguments],
        stdin=child, stdout=child, stderr=subprocess.PIPE, env=os.environ | {"COLUMNS": "200"},
    ) as process:  # fmt: skip
        os.close(child)
        os.write(terminal, "".join(f"{line}\n" for line in ANSWERS[name]).encode())
        shown = b""
        with suppress(OSError):  # the terminal ends with the process
            while part := os.read(terminal, 4096):
                shown += part
        _, err = process.communicate()
    out = shown.decode()
    assert out.count("]: ") == len(ANSWERS[name]), out
    assert (" N m/A" in out) == (name != "no header")
    assert ("assumed" in out.partition("Verdict")[0]) == (name == "no header")
    assert process.returncode in (0, 3), err
    assert "Verdict" in out


@pytest.mark.parametrize("logged", ["libfranka"], indirect=True)
def test_files_of_earlier_fit_are_kept(logged, capsys):
    _, log, _ = logged
    first = identification.fit_log(log, "arm.urdf", method="wls")
    content = Path("log.mcap").read_bytes()
    assert IDENTIFY.main(["fit", log, "arm.urdf"]) == 1
    assert capsys.readouterr().err == (
        "robot-identify: log.mcap: already exists. Run `robot-identify fit log.mcap`, or import "
        "the log again (--overwrite).\n"
    )
    assert Path("log.mcap").read_bytes() == content
    again = identification.fit_log(log, "arm.urdf", method="wls", overwrite=True)
    np.testing.assert_array_equal(again.beta, first.beta)


def test_log_of_bus_with_its_description(tmp_path, monkeypatch, capsys):
    """A candump of the frames of a session gives the fit of the session."""
    monkeypatch.chdir(tmp_path)
    session, robot = REPLAY / "scara" / "session.mcap", REPLAY / "scara" / "robot.toml"
    (frames,) = read_recording(session).frames.values()
    Path("log.log").write_text(
        "".join(
            f"({t * 1e-9:.9f}) can0 {i:03X}#{d.tobytes()[:k].hex().upper()}\n"
            for t, i, k, _, d in frames
        )
    )
    fit = identification.fit_log("log.log", robot)
    assert IDENTIFY.main(["fit", str(session), "--json", "fit.json"]) == 0
    off = np.abs(fit.beta - identification.read_fit("fit.json").beta)
    assert (off < 0.1 * np.array([p.half for p in fit.parameters])).all()
    assert IDENTIFY.main(["fit", "log.log", str(REPLAY / "scara" / "arm.urdf")]) == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    {
        "two logs": (["a.csv", "b.csv", "arm.urdf"], "one log, then its robot"),
        "a recording": ([str(SESSION), "arm.urdf"], "a recording contains its description"),
        "no robot": (["small.csv"], "small.csv ROBOT.urdf`."),
        "a ratio of a robot.toml": (
            ["small.csv", "robot.toml", "--ratio", "3", "--effort-unit", "N m"],
            "--ratio",
        ),
        "another unit than the table's": (
            ["small.csv", "robot.toml", "--position-unit", "rad", "--effort-unit", "A"],
            '--position-unit: the table shows "deg" # from the header. Omit the option.',
        ),
        "a column that is not there": (
            ["small.csv", "robot.toml", "--columns", "position=2-9"],
            "column 6: no column of numbers has this name or number",
        ),
        "no unit": (
            ["small.csv", "robot.toml", "--effort-unit", "Ncm"],
            "--effort-unit = 'Ncm': expected one of A, mA, V, mV, N m, mN m, N, %, per mille",
        ),
        "no columns": (
            ["small.csv", "robot.toml", "--columns", "2-9"],
            "QUANTITY=COLUMNS as position=2-7",
        ),
    }.values(),
)
def test_wrong_use_is_one_line(arguments, told, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    t = np.arange(400) * 0.01
    names = ["time", "q_1[deg]", "q_2[deg]", "tau_1", "tau_2"]
    table("small.csv", names, [t, np.sin(t), np.cos(t), 5 * np.cos(t), 3 * np.sin(t)])
    shutil.copy(REPLAY / "scara" / "robot.toml", "robot.toml")
    before = sorted(tmp_path.iterdir())
    assert IDENTIFY.main(["fit", *arguments]) == 1
    out, err = capsys.readouterr()
    assert told in err
    assert (out, err.count("\n"), sorted(tmp_path.iterdir())) == ("", 1, before)
