"""Tables into recordings: the rule, and every doubt in one line."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from descriptions import COUPLED, ONE_JOINT

from acquisition.errors import BadInputError
from acquisition.importing import ImportSummary, import_tables
from acquisition.recording import read_recording
from acquisition.robot import Robot, robot_from_files
from identification.data import load_signals

ROBOT = COUPLED.replace("[[10, 4], [-3, 20]]", "[[10, 0], [20, 20]]").replace(
    "zero_deg = -45\n", ""
)
MAP = """
sample_rate_hz = 500
[position]
columns = ["p1", "p2"]
unit = "deg"
side = "motor"
[effort]
columns = ["c1", "c2"]
unit = "mA"
side = "motor"
"""
Q = np.array([[0.0, 0.0], [900.0, 1800.0], [-900.0, 0.0]])
CURRENT = np.array([[1000.0, 0.0], [0.0, 2000.0], [-500.0, 4000.0]])
# Joint 1 turns by q_motor / 10 from its zero at 90°; joint 2 by the rest of motor 2 once
# joint 1 is taken off.
POSITION_DEG = np.array([[90, 0], [180, 0], [0, 90]])
# tau = Rᵀ G i: 1 A gives 0.5 N m at motor 1, 0.25 N m at motor 2.
EFFORT = np.array([[5, 0], [10, 10], [17.5, 20]])


@pytest.fixture
def two() -> Robot:
    return robot_from_files({"robot.toml": ROBOT.encode()}, "two")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return csv(tmp_path / "a.csv", "p1,p2,c1,c2", Q, CURRENT)


def csv(path: Path, header: str, *columns: np.ndarray, separator: str = ",") -> Path:
    lines = [separator.join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([*([header] if header else []), *lines, ""]))
    return path


def run(folder: Path, robot: Robot, table_map: str, *tables: Path) -> ImportSummary:
    (folder / "map.toml").write_text(table_map)
    (folder / "out.mcap").unlink(missing_ok=True)
    return import_tables(tables, robot, folder / "map.toml", folder / "out.mcap")


def refusal(
    folder: Path, robot: Robot, table_map: str, *tables: Path
) -> tuple[str, str, object, str]:
    with pytest.raises(BadInputError) as caught:
        run(folder, robot, table_map, *tables)
    assert not (folder / "out.mcap").exists()
    assert not list(folder.glob(".*"))
    error = caught.value
    return (
        error.place.replace(f"{folder}/", ""),
        error.key,
        error.value,
        error.expected or error.text or error.advice,
    )


def test_motor_side_is_converted_to_joint_side(tmp_path, two, table):
    result = run(tmp_path, two, MAP, table)
    recording = read_recording(result.out)
    assert np.rad2deg(recording.samples["position"]) == pytest.approx(POSITION_DEG)
    assert recording.samples["effort"] == pytest.approx(EFFORT)
    assert recording.samples["stamp_ns"].tolist() == [0, 2_000_000, 4_000_000]
    assert recording.samples.dtype.names == ("stamp_ns", "position", "effort")
    assert (recording.sample_rate_hz, len(recording.samples)) == (500.0, 3)
    assert result.effort_units == ("N m", "N m")
    assert recording.metadata["source"] == "tables a.csv"
    told = (
        "a.csv: c1, c2: mA at the motor; joint effort = motor_matrixᵀ · drive gain [0.5, 0.25] "
        "· value, in N m"
    )
    assert recording.metadata["effort_provenance"] == told
    assert recording.attachments["robot.toml"] == ROBOT.encode()
    text = ROBOT.replace('name = "second"\n', 'name = "second"\neffort_nm = 16\n')
    result = run(tmp_path, robot_from_files({"robot.toml": text.encode()}, "two"), MAP, table)
    assert result.warnings == (
        "the effort of joint second reaches 20 N m, above its limit of 16 N m",
    )


def test_signs_turn_columns(tmp_path, two, table):
    turned = csv(tmp_path / "b.csv", "p1,p2,c1,c2", Q * [1, -1], CURRENT * [-1, 1])
    signs = MAP.replace('unit = "deg"', 'unit = "deg"\nsigns = [1, -1]')
    signs = signs.replace('unit = "mA"', 'unit = "mA"\nsigns = [-1, 1]')
    given, wanted = (
        read_recording(run(tmp_path, two, text, path).out).samples
        for text, path in ((signs, turned), (MAP, table))
    )
    for part in ("position", "effort"):
        np.testing.assert_array_equal(given[part], wanted[part])


def test_joint_side_is_unchanged(tmp_path, two, table):
    table_map = (
        MAP.replace("motor", "joint").replace("mA", "mN m")
        + '[reference]\ncolumns = ["p2", "p1"]\n'
    )
    table_map += 'unit = ["deg", "rad"]\nside = "joint"\n'
    assert refusal(tmp_path, two, table_map, table)[:3] == ("map.toml", "position.side", "joint")
    plain = robot_from_files(
        {"robot.toml": ROBOT.replace("zero_deg = 90\n", "").encode()}, "plain.toml"
    )
    recording = read_recording(run(tmp_path, plain, table_map, table).out)
    samples = recording.samples
    assert samples["position"] == pytest.approx(np.deg2rad(Q))
    assert samples["effort"] == pytest.approx(CURRENT * 1e-3)
    assert samples["reference"] == pytest.approx(Q[:, ::-1] * [np.pi / 180, 1])
    assert "reference" in samples.dtype.names
    assert (
        recording.metadata["effort_provenance"]
        == "a.csv: c1, c2: mN m at the joint; joint effort = value in N m"
    )
    # The unit tells the side too: N m can only be the joint's where motors are recorded in A.
    recording = read_recording(
        run(tmp_path, two, MAP.replace('"mA"\nside = "motor"', '"N m"'), table).out
    )
    assert recording.samples["effort"].tolist() == CURRENT.tolist()


@pytest.mark.parametrize("separator", [",", ";", "\t", "  "])
@pytest.mark.parametrize(
    "header",
    ['"p1","p2","c1","c2"', "\ufeffp1,p2,c1,c2", "# x\n# y\np1,p2,c1,c2", "# x\n# p1,p2,c1,c2", ""],
)
def test_csv_variants(tmp_path, two, separator, header):
    table = csv(tmp_path / "a.csv", header.replace(",", separator), Q, CURRENT, separator=separator)
    table.write_text(table.read_text().replace("\n", "\r\n") + "\r\n# end\r\n")
    table_map = (
        MAP if header else MAP.replace('["p1", "p2"]', "[1, 2]").replace('["c1", "c2"]', "[3, 4]")
    )
    samples = read_recording(run(tmp_path, two, table_map, table).out).samples
    assert samples["effort"] == pytest.approx(EFFORT)


def test_text_in_other_columns(tmp_path, two):
    (tmp_path / "a.csv").write_text("when,p1,p2,c1,c2\n12:00,0,0,1000,0\n12:01,900,1800,0,2000\n")
    samples = read_recording(run(tmp_path, two, MAP, tmp_path / "a.csv").out).samples
    assert samples["effort"] == pytest.approx(EFFORT[:2])


def with_time(unit: str, rate: str = "") -> str:
    return MAP.replace("sample_rate_hz = 500", rate) + f'[time]\ncolumn = "t"\nunit = "{unit}"\n'


@pytest.mark.parametrize(("unit", "scale"), [("s", 1.0), ("ms", 1e3), ("us", 1e6), ("ns", 1e9)])
def test_timestamps_lie_on_fitted_grid(tmp_path, two, unit, scale):
    time_s = 2.0 + np.arange(1000) / 500 + np.random.default_rng(0).uniform(-5e-5, 5e-5, 1000)
    table = csv(
        tmp_path / "a.csv", "p1,p2,c1,c2,t", np.zeros((1000, 4)), np.round(time_s * scale, 9)
    )
    recording = read_recording(run(tmp_path, two, with_time(unit), table).out)
    assert recording.sample_rate_hz == 500.0
    assert set(np.diff(recording.samples["stamp_ns"])) == {2_000_000}
    assert recording.samples["stamp_ns"][0] == pytest.approx(time_s[0] * 1e9, abs=1e3)


@pytest.mark.parametrize("rate_hz", [5000.0, 3.0, 44.1, 999.5])
def test_rate_is_roundest_fitting(tmp_path, two, rate_hz):
    table = csv(tmp_path / "a.csv", "p1,p2,c1,c2,t", np.zeros((2000, 4)), np.arange(2000) / rate_hz)
    assert read_recording(run(tmp_path, two, with_time("s"), table).out).sample_rate_hz == rate_hz


def test_short_jittered_record_keeps_rate(tmp_path, two):
    time_s = np.array([0.0, 0.00221, 0.00416]) - 0.01  # 481 Hz; the scatter alone would allow 500
    result = run(
        tmp_path,
        two,
        with_time("s"),
        csv(tmp_path / "a.csv", "p1,p2,c1,c2,t", np.zeros((3, 4)), time_s),
    )
    assert read_recording(result.out).sample_rate_hz == pytest.approx(2 / 0.00416, rel=1e-4)
    assert read_recording(result.out).samples["stamp_ns"] == pytest.approx(
        [0, 2_080_000, 4_160_000], abs=50_000
    )


GRID = np.arange(100) / 500


@pytest.mark.parametrize(
    ("time_s", "rate", "place", "key", "value", "expected"),
    [
        (np.delete(GRID, [7, 8]), "", "a.csv: t", "row 8", None,
         "it comes 0.006 s after the row before, not 0.002 s (2 rows missing)"),
        (np.insert(GRID, 7, GRID[7]), "", "a.csv: t", "row 9", None,
         "its time, 0.014 s, is not later than the one before, 0.014 s"),
        (GRID[::-1], "", "a.csv: t", "row 2", None,
         "its time, 0.196 s, is not later than the one before, 0.198 s"),
        (GRID + 3e-4 * (np.arange(100) == 50), "", "a.csv: t", "row 51", None,
         "it comes 0.0023 s after the row before, not 0.002 s (not uniform)"),
        (GRID * (1 + 0.4 * GRID), "", "a.csv: t", "row 50", None,
         "it is 0.00392 s away from a uniform grid, more than 0.0010792 s"),
        (GRID, "sample_rate_hz = 1000", "map.toml", "sample_rate_hz", 1000.0,
         "the times have a rate of 500 Hz"),
        (GRID * 1e12, "", "a.csv", "", None, "at most 68 years and 100 MHz"),
    ],
)  # fmt: skip
def test_times_without_grid(tmp_path, two, time_s, rate, place, key, value, expected):
    rows = [f"0,0,0,0,{t:.17g}" for t in time_s]
    (tmp_path / "a.csv").write_text("\n".join(["p1,p2,c1,c2,t", *rows]))
    found = refusal(tmp_path, two, with_time("s", rate), tmp_path / "a.csv")
    assert found == (place, key, value, expected)


CELLS = "it has %s cells, but line 1, the column names, has 4"


@pytest.mark.parametrize(
    ("content", "place", "key", "value", "expected"),
    [
        ("", "a.csv", "", None, "the file is empty"),
        ("p1,p2,c1,c2\n", "a.csv", "", None, "the table has no numbers below its header"),
        ("p1,p2,c1,c2\n1,2,3,4\n", "map.toml", "position", None,
         "it has 1 row, but a recording needs 2"),
        ("p1,p2,c1\n1,2,3\n", "a.csv", "", None, "one of p1, p2, c1"),
        ("p1,p2,c1,c2\n1,2,3,4\n1,2,x,4\n", "a.csv: line 3", "c1", "x", "a number"),
        ("p1,p2,c1,c2\n\n# remark\n1,2,3,4\n1,2,,4\n", "a.csv: line 5", "c1", "", "a number"),
        ("p1;p2;c1;c2\n1;2;3;4\n1;2;1.003,5;4\n", "a.csv: line 3", "c1", "1.003.5", "a number"),
        ("p1,p2,c1,c2\n1,2,3,4\n1,2,3\n", "a.csv: line 3", "", None, CELLS % 3),
        ("p1,p2,c1,c2\n1,2,3,4\n1,2,3,5,4\n", "a.csv: line 3", "", None, CELLS % 5),
        ("p1,p2,c1,c2\n1,2,3,4\n1,1e999,3,4\n", "a.csv: row 2", "p2", np.inf, "a finite number"),
        ("1,2,3,4\n1,2,3,4\n", "a.csv", "", None,
         "column 'p1' does not exist: the file has no header line"),
    ],
)  # fmt: skip
def test_csv_mistakes(tmp_path, two, content, place, key, value, expected):
    (tmp_path / "a.csv").write_text(content)
    found = refusal(tmp_path, two, MAP, tmp_path / "a.csv")
    assert tuple(map(repr, found)) == tuple(map(repr, (place, key, value, expected)))


@pytest.mark.parametrize(
    ("old", "new", "key", "value", "expected"),
    [
        ("sample_rate_hz = 500", "", "sample_rate_hz", None, "Set it, or add a [time] table"),
        ("sample_rate_hz = 500", "sample_rate_hz = -1", "sample_rate_hz", -1,
         "a number greater than 0.0"),
        ("sample_rate_hz = 500", "sample_rate_hz = 0.008", "sample_rate_hz", 0.008,
         "it looks like a period, not a rate"),
        ('["p1", "p2"]', '["p1"]', "position.columns", None,
         "the table has 1 such columns for 2 joints"),
        ('unit = "deg"', 'unit = "deg"\nsigns = [1]', "position.signs", None,
         "1 signs are given for 2 joints"),
        ('unit = "deg"', 'unit = "deg"\nsigns = [1, 2]', "position.signs[1]", 2, "one of -1, 1"),
        ('["p1", "p2"]', "[1, 9]", "", None, "1 to 4"),
        ('["p1", "p2"]', "[0, 1]", "", None, "1 to 4"),
        ('unit = "deg"', 'unit = "mm"', "position.unit", None, "an angle"),
        ('unit = "deg"', 'unit = ["deg", "deg", "deg"]', "position.unit", None,
         "3 units are given for 2 joints"),
        ('unit = "deg"\nside = "motor"', 'unit = "deg"', "position.side", None,
         "'motor' or 'joint'"),
        ('unit = "mA"', 'unit = "mV"', "effort.unit", None, "A"),
        ('"mA"\nside = "motor"', '"mA"\nside = "joint"', "effort.unit", None, "N m"),
        ('"mA"\nside = "motor"', '"N"', "effort.unit", None, "A"),
        ('unit = "mA"', 'unit = "mA"\ntable = 2', "effort.table", 2,
         "at most 1, the number of tables"),
        ('unit = "mA"', 'unit = "mA"\nscale = 2', "effort", None,
         "there is an unknown key `scale`"),
        ("sample", 'effort_timing = "x"\nsample', "effort_timing", "x",
         "one of 'command', 'mean', 'measured', 'unknown'"),
    ],
)  # fmt: skip
def test_map_mistakes(tmp_path, two, old, new, key, value, expected, table):
    assert MAP.count(old) == 1
    found = refusal(tmp_path, two, MAP.replace(old, new), table)
    assert found == ("map.toml" if key else "a.csv", key, value, expected)


def test_side_is_optional_without_gear(tmp_path, two, table):
    table_map = MAP.replace('side = "motor"\n', "")
    direct = ROBOT.replace("[[10, 0], [20, 20]]", "[[1, 0], [0, 1]]").replace("zero_deg = 90\n", "")
    robot = robot_from_files({"robot.toml": direct.encode()}, "direct")
    samples = read_recording(run(tmp_path, robot, table_map, table).out).samples
    assert samples["position"] == pytest.approx(np.deg2rad(Q))
    assert samples["effort"] == pytest.approx(CURRENT * [0.5e-3, 0.25e-3])
    geared = direct.replace("[[1, 0], [0, 1]]", "[[1, 0], [0, 2]]")
    for unit in ("drive_gain = 0.5\n", "drive_gain = 0.25\n", 'drive_gain_unit = "N m/A"\n'):
        geared = geared.replace(unit, 'effort_unit = "A"\n' if "unit" in unit else "")
    joint_position = table_map.replace('unit = "deg"', 'unit = "deg"\nside = "joint"')
    in_amperes = robot_from_files({"robot.toml": geared.encode()}, "amperes")
    assert refusal(tmp_path, in_amperes, joint_position, table)[1:3] == ("effort.side", None)


def test_rotary_motor_of_prismatic_joint(tmp_path):
    """A spindle of 5 mm: 2π/0.005 rad at the motor for each metre of the joint, and N m at
    the motor for newtons.
    """
    ratio = 2 * np.pi / 0.005
    slide = SINGLE.replace("KIND", "prismatic").replace("[[motor]]", f"[[motor]]\nratio = {ratio}")
    robot = robot_from_files({"robot.toml": slide.replace("EFFORT", "N m").encode()}, "slide")
    table = csv(tmp_path / "a.csv", "p1,c1", np.array([0.0, 720.0]), np.array([0.0, 1000.0]))
    table_map = MAP.replace(', "p2"', "").replace(', "c2"', "").replace("mA", "mN m")
    result = run(tmp_path, robot, table_map, table)
    samples = read_recording(result.out).samples
    assert samples["position"] == pytest.approx(np.array([[0], [0.01]]))
    assert samples["effort"] == pytest.approx(np.array([[0], [ratio]]))
    assert result.effort_units == ("N",)
    joint_side = table_map.replace('"deg"\nside = "motor"', '"deg"\nside = "joint"')
    assert refusal(tmp_path, robot, joint_side, table) == (
        "map.toml",
        "position.unit",
        None,
        "a length",
    )


def test_units_of_revolute_and_prismatic_joint(tmp_path, two, table):
    """What is expected says how two units are written; as it says, the map is read."""
    described = ROBOT.replace('"revolute"', '"prismatic"', 1).replace("zero_deg = 90\n", "")
    robot = robot_from_files({"robot.toml": described.encode()}, "slide and turn")
    joint_side = MAP.replace('"deg"\nside = "motor"', '"deg"\nside = "joint"')
    assert refusal(tmp_path, robot, joint_side, table)[3] == (
        "a length, one unit for each joint, as ['m', 'rad']"
    )
    stated = joint_side.replace('"deg"', "['m', 'rad']")
    samples = read_recording(run(tmp_path, robot, stated, table).out).samples
    assert samples["position"] == pytest.approx(Q)


def test_mat_mistakes(tmp_path, two):
    path, good = tmp_path / "a.mat", {"p1": Q[:, 0], "p2": Q[:, 1], "c1": CURRENT[:, 0]}
    for extra, expected in (
        ({}, "one of p1, p2, c1"),
        ({"c2": "text"}, "a vector or matrix of real numbers"),
        ({"c2": np.zeros((0, 0))}, "variables of one length, 2 columns in all"),
    ):
        scipy.io.savemat(path, good | extra)
        assert refusal(tmp_path, two, MAP, path) == ("a.mat", "", None, expected)
    numbers = MAP.replace('["c1", "c2"]', "[3, 4]")
    assert refusal(tmp_path, two, numbers, path)[3] == "one of p1, p2, c1, c2"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert refusal(tmp_path, two, MAP, path)[::2] == ("a.mat", None)
    for content in (
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512),
        b"\x89HDF\r\n\x1a\n".ljust(512),
    ):
        path.write_bytes(content)
        assert "the version 7.3" in refusal(tmp_path, two, MAP, path)[3]


SINGLE = (
    ONE_JOINT.replace("revolute", "KIND")
    .replace("ratio = 50\n", "")
    .replace('drive_gain = 0.2\ndrive_gain_unit = "N m/A"', 'effort_unit = "EFFORT"')
)


@pytest.mark.parametrize(
    ("recorded", "position", "effort", "value", "si"),
    [
        ("N m", "deg", "mN m", [180.0, 420.0], [3.141592653589793, 0.42]),
        ("V", "rad", "mV", [0.0, -10.0], [0.0, -0.01]),
        ("N", "mm", "N", [250.0, 0.0], [0.25, 0.0]),
        ("N", "um", "N", [-1500.0, 0.0], [-0.0015, 0.0]),
    ],
)
def test_position_and_effort_units_by_hand(tmp_path, recorded, position, effort, value, si):
    kind = "prismatic" if recorded == "N" else "revolute"
    robot = robot_from_files(
        {"robot.toml": SINGLE.replace("KIND", kind).replace("EFFORT", recorded).encode()}, "x"
    )
    table = csv(tmp_path / "a.csv", "p,c", *np.array([[0.0, 0.0], value]).T)
    table_map = (
        MAP.replace('"p1", "p2"', '"p"')
        .replace('"c1", "c2"', '"c"')
        .replace('side = "motor"\n', "")
    )
    result = run(
        tmp_path,
        robot,
        table_map.replace('"deg"', f'"{position}"').replace('"mA"', f'"{effort}"'),
        table,
    )
    samples = read_recording(result.out).samples
    assert samples["position"][:, 0] == pytest.approx([0.0, si[0]], rel=1e-8)
    assert samples["effort"][:, 0] == pytest.approx([0.0, si[1]], rel=1e-12)
    assert result.effort_units == (recorded,)


def test_invalid_time_unit_or_column_length(tmp_path, two):
    table = csv(tmp_path / "a.csv", "p1,p2,c1,c2,t", np.zeros((3, 4)), np.arange(3.0))
    short = csv(tmp_path / "b.csv", "t", np.arange(2.0))
    found = refusal(tmp_path, two, with_time("min"), table)
    assert found == ("map.toml", "time.unit", "min", "one of s, ms, us, ns")
    two_tables = with_time("s") + "table = 2\n"
    assert refusal(tmp_path, two, two_tables, table, short)[::3] == (
        "map.toml",
        "one column of 3 rows",
    )
    assert refusal(tmp_path, two, two_tables, table)[1:3] == ("time.table", 2)
    tables = csv(tmp_path / "a.csv", "p1,p2", Q), csv(tmp_path / "b.csv", "c1,c2", CURRENT[:2])
    table_map = MAP.replace('unit = "mA"', 'unit = "mA"\ntable = 2')
    assert refusal(tmp_path, two, table_map, *tables) == (
        "map.toml",
        "effort",
        None,
        "it has 2 rows, but position has 3",
    )


@pytest.mark.parametrize("timing", ["unknown", "command", "mean", "measured"])
def test_effort_timing_is_from_map(tmp_path, two, timing, table):
    stated = "" if timing == "unknown" else f'effort_timing = "{timing}"\n'
    assert load_signals(run(tmp_path, two, stated + MAP, table).out).effort_timing == timing


def test_missing_files_are_named(tmp_path, two):
    assert refusal(tmp_path, two, MAP, tmp_path / "none.csv")[0] == "none.csv"
    assert refusal(tmp_path, two, MAP, tmp_path)[0] == str(tmp_path)
    with pytest.raises(BadInputError, match=r"none\.toml: the file cannot be read: No such file"):
        import_tables([], two, tmp_path / "none.toml", tmp_path / "out.mcap")
