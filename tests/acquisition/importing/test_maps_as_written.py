"""Tables through `robot-acquire import` by the map that it proposes, nothing but FILL IN filled in:
the recording has the rows that the table was written from.
"""

import json
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from acquisition.commands import main
from acquisition.recording import read_recording
from acquisition.robot import FILL_IN

J, N, PERIOD_S = ("shoulder", "elbow", "wrist"), 1200, 0.004
ROS = [2, 0, 1]  # the joints in the order of a driver
LINK = "dh = { alpha_deg = 0, d_m = 0, theta_deg = 0, r_m = 0 }\n"
K = np.arange(N)
T = K * PERIOD_S
PHASE = np.arange(3)
Q = np.sin(np.outer(T, [2.0, 3.0, 4.0]) + PHASE) * [0.5, 0.7, 0.9]
U = np.cos(np.outer(T, [3.0, 5.0, 2.0]) - PHASE) * [5, 6, 7]
RAD, NM = {"position.unit": "rad"}, {"effort.unit": "N m", "effort.side": "joint"}
COLUMNS = {"position.columns": [2, 3, 4], "effort.columns": [5, 6, 7]}
NAMED = "t,q1,q2,q3,tau1,tau2,tau3"


def describe(folder: Path, unit: str = "N m", ratio: float = 1.0) -> None:
    """`robot.toml` of an arm whose efforts are in `unit`."""
    joints = "".join(
        f'[[joint]]\nname = "{name}"\ntype = "revolute"\n{LINK}[[motor]]\nname = "m_{name}"\n'
        f'effort_unit = "{unit}"\nratio = {ratio}\n'
        for name in J
    )
    (folder / "robot.toml").write_text(f'name = "arm"\n{joints}[controller]\n')


def csv(*columns, header: str = "", mark: str = ",", code: str = "utf-8") -> bytes:
    """A table of times, matrices and texts, which stand in all rows."""
    cells = []
    for x in columns:
        if isinstance(x, str):
            cells.append([x] * N)
        else:
            cells += [[f"{v:.9f}".rstrip("0").rstrip(".") for v in y] for y in np.atleast_2d(x.T)]
    rows = [mark.join(row) for row in zip(*cells, strict=False)]
    return "\n".join([*([header] if header else []), *rows, ""]).encode(code)


def mat(path: Path, **variables) -> None:
    scipy.io.savemat(path, variables)


def cells(*texts: str) -> np.ndarray:
    """A cell array of MATLAB."""
    array = np.empty((len(texts), 1), object)
    array[:, 0] = texts
    return array


def fill_in(table_map: Path, values: dict) -> None:
    """Write the values in place of FILL IN, each of which is needed."""
    section, lines, left = "", [], dict(values)
    for k, line in enumerate(table_map.read_text().splitlines()):
        section = line.strip("[]") + "." if line.startswith("[") else section
        key = section + line.split(" = ")[0]
        if FILL_IN in line and k:
            lines.append(f"{line.split(' = ')[0]} = {json.dumps(left.pop(key))}")
        else:
            lines.append(line)
    assert not left
    table_map.write_text("\n".join([*lines, ""]))


def imported(folder: Path, monkeypatch, name: str, values: dict):
    """The samples, and what the second command wrote."""
    monkeypatch.chdir(folder)
    command = ["import", name, "--robot", "robot.toml"]
    assert main(command) == 0
    table_map, recording = Path(name).with_suffix(".map.toml"), Path(name).with_suffix(".mcap")
    if values:
        assert not recording.exists()
        fill_in(table_map, values)
        assert main(command) == 0
    return read_recording(recording).samples


PARTS = (("q", Q), ("tau", U))
MAT = {
    "struct": ({"data": {"t": T, "q": Q, "tau": U, "note": "text", "gain": 3.0}}, RAD | NM),
    "joints by samples in nested structs": (
        {"log": {"time": 1e3 * T, "joint": {"position": Q.T, "torque": U.T}}, "A": np.eye(4)},
        RAD | NM,
    ),
    "vectors in a struct whose name is a word": (
        {"d": {"t": T, **{f"{name}{j}": x[:, j] for name, x in PARTS for j in PHASE}}},
        RAD | NM,
    ),
    "names of joints in a cell array": (
        {"t": T,
         "s": {"name": cells(*(J[k] for k in ROS)), "position": Q[:, ROS], "effort": U[:, ROS]}},
        RAD | NM,
    ),
    "one matrix": (
        {"data": np.column_stack([T, Q, U])},
        RAD | NM | {
            f"{key}.columns": [f"data(:,{k})" for k in numbers]
            for key, numbers in (("position", (2, 3, 4)), ("effort", (5, 6, 7)))
        },
    ),
    "records of other lengths beside it": (
        {"id": {"t": T, "q": Q, "tau": U}, "val": {"t": T[:4], "q": Q[:4]}, "x": np.arange(9e3)},
        RAD | NM,
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", MAT)
def test_mat_files(tmp_path, monkeypatch, kind):
    variables, values = MAT[kind]
    describe(tmp_path)
    mat(tmp_path / "x.mat", **variables)
    samples = imported(tmp_path, monkeypatch, "x.mat", values)
    assert np.array_equal(samples["position"], Q)
    assert np.array_equal(samples["effort"], U)


def ros(*names: str, before: str = "") -> str:
    """The header of `rostopic echo -p`, times and names of joints."""
    kinds = ("name", "position", "effort")
    return f"%time,{before}" + ",".join(f"field.{x}{k}" for x in kinds for k in range(len(names)))


NS = 1e9 * (1_714_564_800 + T)
DRIVER = [J[k] for k in ROS]
LATE = NS + np.random.default_rng(3).uniform(0, 1e6, N)
STAMPED = "field.header.seq,field.header.stamp,field.header.frame_id,"
ZERO, EIGHT = np.zeros(N), {"position.columns": [3, 4, 5], "effort.columns": [6, 7, 8]}
CSV = {
    "without a header": (csv(T, Q, U), RAD | NM | COLUMNS),
    "without a header, decimal commas": (
        csv(T, Q, U, mark=";").replace(b".", b","), RAD | NM | COLUMNS
    ),
    "without a header, blanks, a counter, ms": (
        csv(K, 1e3 * T, Q, U, mark=" "), RAD | NM | EIGHT
    ),
    "without a header, epoch in us": (csv(1e-3 * NS, Q, U, mark="\t"), RAD | NM | COLUMNS),
    "rostopic echo -p": (csv(NS, *DRIVER, Q[:, ROS], U[:, ROS], header=ros(*DRIVER)), NM),
    "rostopic echo -p, a gripper, stamps of the header": (
        csv(
            LATE, K, NS, "", "gripper", *DRIVER, ZERO + 0.5, Q[:, ROS], ZERO, U[:, ROS],
            header=ros("gripper", *DRIVER, before=STAMPED),
        ), NM,
    ),
    "names in numbered columns": (
        csv(T, *DRIVER, Q[:, ROS], U[:, ROS],
            header="t," + ",".join(f"{x}[{k}]" for x in ("names", "pos", "torque") for k in PHASE)),
        RAD | NM,
    ),
    "ros2 topic echo --csv": (
        csv(NS // 1e9, NS % 1e9, "", *DRIVER, Q[:, ROS], U[:, ROS]),
        RAD | NM | {"sample_rate_hz": 250}
        | {"position.columns": [8, 9, 7], "effort.columns": [11, 12, 10]},
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", CSV)
def test_tables_without_names_or_names_in_cells(tmp_path, monkeypatch, kind):
    """All rows are there, also the first, which is no header."""
    content, values = CSV[kind]
    describe(tmp_path)
    (tmp_path / "x.csv").write_bytes(content)
    samples = imported(tmp_path, monkeypatch, "x.csv", values)
    assert np.abs(samples["position"] - Q).max() < 1e-9
    assert np.abs(samples["effort"] - U).max() < 1e-9
    assert np.allclose(np.diff(samples["stamp_ns"]), 4e6)


def test_unnamed_columns_are_listed_with_range(tmp_path, monkeypatch):
    describe(tmp_path)
    monkeypatch.chdir(tmp_path)
    Path("x.csv").write_bytes(csv(T, *DRIVER, np.where(K < 1100, 0.0, -7.5), Q))
    assert main(["import", "x.csv", "--robot", "robot.toml"]) == 0
    told = Path("x.map.toml").read_text().splitlines()[1:8]
    assert told[1:6] == [
        "#   1: 0 to 4.796", "#   2: wrist", "#   3: shoulder", "#   4: elbow", "#   5: -7.5 to 0"
    ]  # fmt: skip


MILLE = {
    "utf-8": ("Moment {} [‰]", "utf-8"),
    "Windows": ("Moment {} [‰]", "cp1252"),
    "UTF-16": ("Drehmoment {} (‰)", "utf-16"),
    "a sign alone": ("torque_{} ‰", "cp1252"),
    "in words": ("torque {} [per mille]", "ascii"),
}


@pytest.mark.parametrize("kind", MILLE)
def test_per_mille_is_tenth_of_percent(tmp_path, monkeypatch, kind):
    pattern, code = MILLE[kind]
    describe(tmp_path, "%")
    header = ",".join(
        ["t [s]", *(f"q{j} [rad]" for j in "123"), *(pattern.format(j) for j in "123")]
    )
    (tmp_path / "x.csv").write_bytes(csv(T, Q, 10 * U, header=header, code=code))
    samples = imported(tmp_path, monkeypatch, "x.csv", {})
    assert np.abs(samples["effort"] - U).max() < 1e-9
    written = (tmp_path / "x.map.toml").read_text().replace('"per mille"', '"‰"')
    (tmp_path / "y.csv").write_bytes((tmp_path / "x.csv").read_bytes())
    (tmp_path / "y.map.toml").write_text(written, encoding="utf-8")
    assert main(["import", "y.csv", "--robot", "robot.toml"]) == 0
    assert np.array_equal(read_recording(Path("y.mcap")).samples["effort"], samples["effort"])


TURN = 2 * np.pi
AWAY = Q + np.array([np.pi - 0.01 - Q[1001, 0], -0.5, -3.0])
REFERENCE = AWAY + 0.02


def wrapped(x, low: float, scale: float = 1.0):
    return scale * ((x - low) % TURN + low)


@pytest.mark.parametrize(
    ("low", "scale"), [(-np.pi, 1.0), (0.0, 1.0), (-np.pi, 180 / np.pi), (0.0, 180 / np.pi)]
)
def test_wrapped_angles_are_unwrapped(tmp_path, monkeypatch, low, scale):
    """The joint moves through the jump, the reference in its turn; no jump is in the first rows."""
    describe(tmp_path)
    q, ref = (np.where(K[:, None] < 1001, x[1001], x) for x in (AWAY, REFERENCE))
    names = [f"{x}{j}" for x in ("q", "q_ref", "tau") for j in "123"]
    table = csv(
        T, wrapped(q, low, scale), wrapped(ref, low, scale), U, header=",".join(["t", *names])
    )
    (tmp_path / "x.csv").write_bytes(table)
    samples = imported(tmp_path, monkeypatch, "x.csv", NM)
    turns = np.rint((samples["position"] - q) / TURN)
    assert (turns == turns[0]).all()
    assert np.abs(samples["position"] - q - TURN * turns).max() < 1e-9
    assert np.abs(samples["reference"] - samples["position"] - ref + q).max() < 1e-9
    assert np.abs(np.median(samples["position"], axis=0)).max() <= np.pi


def test_speeds_of_angles_wrapped_in_first_rows(tmp_path, monkeypatch):
    describe(tmp_path)
    names = [f"{x}{j}" for x in ("q", "qd", "tau") for j in "123"]
    q = Q + np.array([3.0, 0.0, -3.0])
    speed = np.gradient(q, PERIOD_S, axis=0)
    table = csv(T, wrapped(q, -np.pi), speed, U, header=",".join(["t", *names]))
    (tmp_path / "x.csv").write_bytes(table)
    assert np.abs(imported(tmp_path, monkeypatch, "x.csv", NM)["velocity"] - speed).max() < 1e-9


def burst(size: int, inside_s: float = 1e-4):
    """Times at which packets of rows were read."""
    return (K // size * size + size - 1) * PERIOD_S + K % size * inside_s


NOISE = np.random.default_rng(7)
ARRIVALS = np.maximum.accumulate(burst(10) + np.repeat(NOISE.exponential(4e-3, N // 10), 10))
BURSTS = {
    "packets of ten": burst(10),
    "one stamp for each packet": burst(8, 0.0),
    "pairs": burst(2),
    "jitter of the arrival": ARRIVALS,
    "a clock that is off by 100 ppm": burst(10) * (1 + 1e-4),
}


@pytest.mark.parametrize("kind", BURSTS)
def test_bursts_are_resolved_by_given_rate(tmp_path, monkeypatch, capsys, kind):
    describe(tmp_path)
    noisy = Q + 1e-4 * NOISE.normal(size=Q.shape)
    (tmp_path / "x.csv").write_bytes(csv(BURSTS[kind], noisy, U, header=NAMED))
    samples = imported(tmp_path, monkeypatch, "x.csv", RAD | NM)
    assert "resample_hz = 250 # timestamps come in bursts" in (tmp_path / "x.map.toml").read_text()
    assert "times: even times of 1200 rows" in capsys.readouterr().out
    assert len(samples) == N
    assert np.abs(samples["position"] - noisy).max() < 1e-8
    assert np.abs(samples["effort"] - U).max() < 1e-8


def test_duplicate_rows_are_no_bursts(tmp_path, monkeypatch):
    describe(tmp_path)
    twice = K // 2 * 2
    (tmp_path / "x.csv").write_bytes(csv(T[twice], Q[twice], U[twice], header=NAMED))
    samples = imported(tmp_path, monkeypatch, "x.csv", RAD | NM)
    assert np.abs(samples["position"] - Q[: len(samples)]).max() < 1e-5


def refused(folder, monkeypatch, capsys, content: bytes, table_map: str = "") -> str:
    """The one line of the error; nothing is written."""
    monkeypatch.chdir(folder)
    Path("x.csv").write_bytes(content)
    if table_map:
        Path("x.map.toml").write_text(table_map)
    assert main(["import", "x.csv", "--robot", "robot.toml"]) == 1
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert not Path("x.mcap").exists()
    return line


def a_map(time: str = 'column = "t"', more: str = "", side: str = "joint") -> str:
    position = f'[position]\ncolumns = ["q1", "q2", "q3"]\nunit = "rad"\nside = "{side}"\n{more}\n'
    effort = '[effort]\ncolumns = ["tau1", "tau2", "tau3"]\nunit = "N m"\nside = "joint"\n'
    return f"[time]\n{time}\n{position}{effort}"


RATE = 'column = "t"\nresample_hz = {}'
LOST = np.r_[0:600, 610:N]
FAST = np.column_stack([1.8 * K, Q[:, 1:]])
REFUSED = {
    "jumps that the map does not state": (
        wrapped(AWAY, 0.0), T, a_map(), 1, "position.unwrap = False"
    ),
    "jumps of motors with a ratio": (
        wrapped(60 * AWAY, 0.0), T, a_map(side="motor"), 60, "position.unwrap = False"
    ),
    "jumps of motors with a ratio, stated": (
        wrapped(60 * AWAY, 0.0), T, a_map(more="unwrap = true", side="motor"), 60,
        "position.unwrap = True",
    ),
    "steps that may be jumps": (
        wrapped(FAST, 0.0), T, a_map(more="unwrap = true"), 1, "position.unwrap = True"
    ),
    "a key of angles for efforts": (Q, T, a_map() + "unwrap = true\n", 1, "unwrap"),
    "a packet that is missing": (
        Q[LOST], burst(10)[LOST], a_map(RATE.format(250)), 1, "time.resample_hz = 250"
    ),
    "another rate than that of the bursts": (
        Q, burst(10), a_map(RATE.format(500)), 1, "Set it to 250.0"
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_invalid_or_undecided_map_is_refused(tmp_path, monkeypatch, capsys, kind):
    q, t, table_map, ratio, named = REFUSED[kind]
    describe(tmp_path, ratio=ratio)
    line = refused(tmp_path, monkeypatch, capsys, csv(t, q, U[: len(t)], header=NAMED), table_map)
    assert named in line


def test_one_joint_per_row_is_refused(tmp_path, monkeypatch, capsys):
    describe(tmp_path)
    long = "t,joint,position,effort\n" + "".join(
        f"{t:.3f},{J[j]},{Q[k, j]:.6f},{U[k, j]:.6f}\n" for k, t in enumerate(T) for j in range(3)
    )
    assert "column joint" in refused(tmp_path, monkeypatch, capsys, long.encode())
    rows = csv(T, *DRIVER, Q[:, ROS], U[:, ROS], header=ros(*DRIVER)).decode().splitlines()
    rows[1101] = rows[1101].replace("wrist,shoulder", "shoulder,wrist")
    assert "column field.name0" in refused(tmp_path, monkeypatch, capsys, "\n".join(rows).encode())


@pytest.mark.parametrize("names", [("a", "b", "c"), ("wrist", "elbow", "tool"), (*J, "wrist")])
def test_other_joint_names_leave_order_open(tmp_path, monkeypatch, names):
    describe(tmp_path)
    monkeypatch.chdir(tmp_path)
    k = np.arange(len(names)) % 3
    Path("x.csv").write_bytes(csv(NS, *names, Q[:, k], U[:, k], header=ros(*names)))
    assert main(["import", "x.csv", "--robot", "robot.toml"]) == 0
    assert Path("x.map.toml").read_text().count(f'columns = ["{FILL_IN}"]') == 2
