"""Maps that `import` proposes for tables of other tools: headers as their makers document them,
or as labs write them.
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from acquisition.commands import main
from acquisition.importing import propose_map
from acquisition.recording import read_recording
from acquisition.robot import FILL_IN, Robot, robot_from_files

N = 6
NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


POSITION, REFERENCE, VELOCITY, EFFORT = "position", "reference", "velocity", "effort"
TABLES = {"q": POSITION, "ref": REFERENCE, "v": VELOCITY, "tau": EFFORT, "i": EFFORT}


@dataclass(frozen=True, kw_only=True)
class Header:
    """`columns`: names and quantities; `{0}` counts from 0, `{1}` from 1, `{n}` names a joint.

    `open` tables cannot be told.
    """

    tool: str
    columns: str
    angle: str = ""
    effort: str = ""
    open: tuple[str, ...] = ()
    step: float = 0.004
    unit: str = "s"
    separator: str = ","
    joints: int = N
    scale: float = 0.0  # of positions, from rad

    @property
    def quantities(self) -> dict[str, str]:
        return dict(part.rsplit(" ", 1) for part in self.columns.split("; "))

    @property
    def truth(self) -> dict[str, str]:
        """The quantities that belong into the map's tables; of torques and currents, currents."""
        return {
            TABLES[x]: x
            for x in TABLES
            if x in self.quantities.values() and TABLES[x] not in self.open
        }

    @property
    def units(self) -> dict[str, str]:
        angles = (
            {POSITION: self.angle, REFERENCE: self.angle, VELOCITY: f"{self.angle}/s"}
            if self.angle
            else {}
        )
        return angles | {EFFORT: self.effort}


STATE = "/arm_controller/controller_state"
HEADERS = [
    Header(
        tool="ur rtde", separator=" ", angle="rad", effort="A",
        columns="timestamp t; target_q_{0} ref; target_qd_{0} vref; target_qdd_{0} acc; "
        "target_current_{0} other; target_moment_{0} other; actual_q_{0} q; actual_qd_{0} v; "
        "actual_current_{0} i; actual_current_window_{0} other; joint_control_output_{0} other; "
        "actual_TCP_pose_{0} other; actual_TCP_speed_{0} other; joint_temperatures_{0} other; "
        "actual_joint_voltage_{0} other; actual_current_as_torque_{0} tau",
    ),
    Header(
        tool="libfranka", step=1.0, unit="ms", joints=7, angle="rad", effort="N m",
        columns="time t; success_rate other; state.q[{0}] q; state.q_d[{0}] ref; state.dq[{0}] v; "
        "state.dq_d[{0}] vref; state.tau_J[{0}] tau; state.tau_ext_hat_filtered[{0}] other; "
        "cmd.q_d[{0}] other; cmd.dq_d[{0}] vref; cmd.O_T_EE_d[{0}] other; cmd.tau_J_d[{0}] other",
    ),
    Header(
        tool="ros2_control, controller_state", angle="rad",
        columns=f"__time t; {STATE}/reference/positions[{{0}}] ref; "
        f"{STATE}/reference/velocities[{{0}}] vref; "
        f"{STATE}/feedback/positions[{{0}}] q; {STATE}/feedback/velocities[{{0}}] v; "
        f"{STATE}/feedback/effort[{{0}}] tau; "
        f"{STATE}/error/positions[{{0}}] other",
    ),
    Header(
        tool="joint_states by name", step=2e6, unit="ns", angle="rad",
        columns="%time t; /joint_states/{n}/position q; /joint_states/{n}/velocity v; "
        "/joint_states/{n}/effort tau",
    ),
    Header(
        tool="german", step=0.002, separator=";", angle="deg", effort="A",
        columns="Zeit t; Ist-Position Achse {1} [°] q; Soll-Position Achse {1} [°] ref; "
                "Motorstrom " "Achse {1} [A] i; "
        "Temperatur Achse {1} [°C] other",
    ),
    Header(
        tool="french", step=2.0, unit="ms", separator="\t", angle="rad", effort="N m",
        columns="temps (ms) t; position_mesurée_{1} (rad) q; vitesse_{1} (rad/s) v; couple_{1} "
        "(Nm) tau; consigne_position_{1} (rad) ref",
    ),
    Header(tool="chinese",
           columns="时间 t; 关节{1}实际位置 q; 关节{1}目标位置 ref; 关节{1}实际力矩 tau",
           angle="deg"),
    Header(tool="matlab", columns="t t; q{1} q; q_des{1} ref; qd{1} v; qdd{1} acc; u{1} other; "
                                  "tau{1} tau"),
    Header(
        tool="kuka rsi", step=4.0, unit="ms", scale=57.3, open=(POSITION, REFERENCE, EFFORT),
        columns="Time t; AIPos.A{1} q; ASPos.A{1} ref; MACur.A{1} i",
    ),
    Header(
        tool="two arms", open=(POSITION, EFFORT),
        columns="time t; left_q_{0} q; right_q_{0} other; left_tau_{0} tau; right_tau_{0} other",
    ),
    Header(
        tool="two efforts", open=(EFFORT,),
        columns="time t; q_{0} q; joint_torque_{0} tau; motor_current_{0} i",
    ),
]  # fmt: skip


def values(header: Header, rows: int = 600) -> dict[str, np.ndarray]:
    seconds = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[header.unit] * header.step
    t, k = np.arange(rows) * seconds, np.arange(header.joints)
    scale = header.scale or (57.3 if header.angle == "deg" else 1.0)
    w = 2 * np.pi * (2 + k) / t[-1]
    q = scale * 1.3 * np.sin(np.outer(t, w) + k)
    v = scale * 1.3 * w * np.cos(np.outer(t, w) + k)
    ref = scale * 1.3 * np.sin(np.outer(t + 0.001 * t[-1], w) + k)
    noise = np.random.default_rng(5)
    others = {
        name: noise.normal(size=q.shape) * size
        for name, size in (("i", 3), ("tau", 40), ("acc", 9), ("other", 77))
    }
    times = (header.step * np.arange(rows))[:, None] + 17 * header.step
    return {"q": q, "ref": ref, "v": v, "vref": 1.01 * v, "t": times, **others}


def write(path: Path, header: Header) -> list[str]:
    """The table; what each column is, as `q 0`."""
    names, what, columns, given = [], [], [], values(header)
    for pattern, quantity in header.quantities.items():
        for j in range(given[quantity].shape[1] if "{" in pattern else 1):
            names.append(
                pattern.replace("{0}", str(j))
                .replace("{1}", str(j + 1))
                .replace("{n}", NAMES[j % N])
            )
            what.append(f"{quantity} {j}")
            columns.append(given[quantity][:, j])
    point = "," if header.separator == ";" else "."
    lines = [
        header.separator.join(f"{x:.9g}".replace(".", point) for x in row)
        for row in zip(*columns, strict=True)
    ]
    path.write_text("\n".join([header.separator.join(names), *lines, ""]), encoding="utf-8")
    return what


def robot_of(header: Header) -> Robot:
    joints = NAMES if "{n}" in header.columns else [f"j{j + 1}" for j in range(header.joints)]
    row = "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }\n"
    text = "".join(
        f'[[joint]]\nname = "{name}"\ntype = "revolute"\n{row}[[motor]]\nname = '
        f'"m_{name}"\neffort_unit = "A"\n'
        for name in joints
    )
    return robot_from_files(
        {"robot.toml": f'name = "arm"\n{text}[controller]\n'.encode()}, "robot.toml"
    )


@pytest.mark.parametrize("described", [True, False])
@pytest.mark.parametrize("header", HEADERS, ids=lambda header: header.tool)
def test_proposed_columns_and_units_are_right(tmp_path, header, described):
    """With a description all tables are found but where the names do not tell: units, and the
    side of efforts, are left.
    """
    what = write(tmp_path / "x.csv", header)
    proposed = tomllib.loads(
        propose_map(tmp_path / "x.csv", robot_of(header) if described else None)
    )
    first, mark = (
        (tmp_path / "x.csv").read_text().splitlines()[0],
        header.separator.strip() or header.separator,
    )
    names = [x.strip() for x in first.split(mark)]
    for table in (POSITION, REFERENCE, VELOCITY, EFFORT):
        found = proposed.get(table, {"columns": [FILL_IN], "unit": FILL_IN})
        if found["columns"] != [FILL_IN]:
            numbers = [c - 1 if isinstance(c, int) else names.index(c) for c in found["columns"]]
            assert [what[k] for k in numbers] == [
                f"{header.truth.get(table)} {j}" for j in range(header.joints)
            ], table
        elif described:
            assert table == VELOCITY or table not in header.truth
        if found["unit"] != FILL_IN:
            assert found["unit"] == header.units.get(table), table
    if described or "time" in proposed:
        assert proposed["time"]["unit"] == header.unit
    assert "effort_timing" not in proposed


def test_false_reference_and_speed_are_not_proposed(
    tmp_path,
):
    write(
        tmp_path / "x.csv",
        Header(tool="wrong names", columns="t t; q{1} q; q_ref{1} other; dq{1} acc; tau{1} tau"),
    )
    text = propose_map(tmp_path / "x.csv", None)
    assert tomllib.loads(text)["reference"]["columns"] == [FILL_IN]
    assert "velocity" not in tomllib.loads(text)
    assert "# no [velocity]: not the derivative of the position: " in text


SCOPE = """Name{0}YT Scope Project
File{0}C:\\Users\\lab\\scope.tcscopex
Starttime of export{0}133238090039920000{0}Monday, March 20, 2023{0}19:03:23.992
Endtime of export{0}133238090049920000{0}Monday, March 20, 2023{0}19:03:24.992

"""


@pytest.mark.parametrize(("separator", "each"), [("\t", True), (";", False)])
def test_twincat_scope_export(tmp_path, monkeypatch, capsys, separator, each):
    header = Header(tool="", columns="", step=2.0, unit="ms", joints=2, angle="deg")
    given, names, columns = values(header), [], []
    for j in range(2):
        for name, x in (
            ("ActPos", given["q"]),
            ("SetPos", given["ref"]),
            ("ActTorque", given["tau"]),
        ):
            names.append(f"Axis {j + 1}.{name}")
            columns += [2.0 * np.arange(len(x))] * (each or not columns) + [x[:, j]]
    pairs = {
        "Name": names,
        "SymbolComment": [""] * 6,
        "Data-Type": ["REAL64"] * 6,
        "SampleTime[ms]": ["2"] * 6,
    }
    lines = [
        separator.join(x for k, text in enumerate(texts) for x in (*[key] * (each or not k), text))
        for key, texts in pairs.items()
    ]
    rows = [
        separator.join(f"{x:.9g}".replace(".", ",") for x in row)
        for row in zip(*columns, strict=True)
    ]
    (tmp_path / "x.csv").write_text(
        SCOPE.format(separator) + "\n".join([*lines, "", *rows, "EOF", ""])
    )
    description = robot_of(header).files["robot.toml"]
    (tmp_path / "robot.toml").write_bytes(
        description.replace(b'effort_unit = "A"', b'effort_unit = "N m"')
    )
    monkeypatch.chdir(tmp_path)
    command = ["import", "x.csv", "--robot", "robot.toml"]
    assert main(command) == 0
    proposed = (tmp_path / "x.map.toml").read_text()
    assert tomllib.loads(proposed)["time"]["unit"] == "ms"
    stated = proposed.replace('unit = "FILL IN"', 'unit = "N m"').replace(
        'side = "FILL IN"', 'side = "joint"'
    )
    (tmp_path / "x.map.toml").write_text(stated)
    assert main(command) == 0
    assert (
        "x.mcap: arm, 600 samples at 500 Hz, effort in N m, with reference\n"
        in capsys.readouterr().out
    )
    samples = read_recording(tmp_path / "x.mcap").samples
    for name, x, scale in (
        ("position", "q", 180 / np.pi),
        ("reference", "ref", 180 / np.pi),
        ("effort", "tau", 1),
    ):
        np.testing.assert_allclose(samples[name] * scale, given[x], rtol=1e-7, atol=1e-6)


def test_uneven_times_are_interpolated(tmp_path):
    t = np.arange(300) * 0.01 + 0.003 * (np.arange(300) % 3 == 0)
    (tmp_path / "x.csv").write_text(
        "t,q,tau\n" + "".join(f"{x:.4f},{np.sin(x):.6f},1\n" for x in t)
    )
    assert "resample_hz = 100 # the steps are uneven" in propose_map(tmp_path / "x.csv", None)
    (tmp_path / "x.csv").write_text(
        "t,q,tau\n" + "".join(f"{0.1 * k:.2f},{np.sin(k):.6f},1\n" for k in range(300))
    )
    assert tomllib.loads(propose_map(tmp_path / "x.csv", None))["time"]["unit"] == FILL_IN


def test_unit_lines_are_skipped(
    tmp_path,
):
    rows = "".join(f"{0.01 * k:.2f};{np.sin(k):.6f};1\n" for k in range(300))
    proposed = []
    for head in ("t;q;tau\ns;rad;Nm\nLREAL;LREAL;LREAL\n", "t;q;tau\n", ""):
        (tmp_path / "x.csv").write_text(head + rows)
        proposed.append(propose_map(tmp_path / "x.csv", None))
    assert proposed[0] == proposed[1]
    named, unnamed = map(tomllib.loads, proposed[1:])
    assert named["position"]["columns"] == ["q"]
    assert [unnamed[table]["columns"] for table in (POSITION, EFFORT)] == [[FILL_IN]] * 2
    assert unnamed["time"] == {"column": 1, "unit": "s"}
