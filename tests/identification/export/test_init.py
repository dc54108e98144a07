"""A URDF as a description by init, which other commands ask for; dynamics against
pinocchio's own reading.
"""

import re
import tomllib
from pathlib import Path

import command_runs
import mujoco
import numpy as np
import pinocchio as pin
import pytest
from command_runs import run
from urdfs import ARM, BOX, LIMIT, PARTS, joint, link, urdf

from acquisition.errors import RobotIdimError
from acquisition.robot import (
    check_limits,
    lines_to_fill_in,
    load_robot,
    refuse_load,
    resolve,
)
from acquisition.simulated import driven_plant
from identification import fit, read_robot
from identification.export import read_chain, robot_of_chain
from identification.model import InverseModel

STATED = ["--acceleration", "8,8,2", "--following-error", "0.2,0.2,0.05", "--bandwidth-hz", "5"]
NAMES = ["--joints", ",".join(ARM)]


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    (tmp_path / "arm.urdf").write_text(urdf())
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refused(capsys, *arguments):
    return command_runs.refused(capsys, *arguments).strip().removeprefix("robot-identify: ")


def torque_of_the_urdf(text, names, states):
    """pinocchio's torque at the joints `names` of the URDF as it stands, all other
    joints at rest at zero.
    """
    model = pin.buildModelFromXML(text)
    data, tau = model.createData(), []
    places = [model.joints[model.getJointId(name)] for name in names]
    for state in zip(*states, strict=True):
        whole = [pin.neutral(model), np.zeros(model.nv), np.zeros(model.nv)]
        for k, place in enumerate(places):
            for x, given in zip(whole, state, strict=True):
                x[place.idx_v] = given[k]
        tau.append(pin.rnea(model, data, *whole)[[place.idx_v for place in places]])
    return np.array(tau)


@pytest.mark.parametrize("names", [(*ARM, "finger"), ("turn", "slide")])
def test_parameters_match_urdf_torque(here, capsys, names):
    """Fixed and locked links are part of the link that carries them; the axis of the first joint is
    along none of the frame.
    """
    assert run(capsys, "init", "arm.urdf", "--joints", ",".join(names), "-o", "robot.toml")[0] == 0
    robot = load_robot("robot.toml")
    dynamics = InverseModel(robot)
    chi = np.array([robot.parameters.get(name, 0.0) for name in dynamics.names])
    states = np.random.default_rng(3).normal(size=(3, 20, len(names)))
    tau = torque_of_the_urdf(urdf(), names, states)
    # damping and friction of the first joint
    tau[:, 0] += 0.6 * states[1, :, 0] + 0.25 * np.sign(states[1, :, 0])
    assert np.abs(tau).max() > 5
    np.testing.assert_allclose(dynamics.regressor(*states) @ chi, tau, atol=1e-11)


def test_init_writes_urdf_values_and_marks_rest(here, capsys):
    status, out, err = run(capsys, "init", "arm.urdf", "-o", "robot.toml")
    text, robot = (here / "robot.toml").read_text(), load_robot("robot.toml")
    assert (status, err) == (0, "")
    assert out.splitlines()[:6] == [
        "robot.toml: 3 joints of arm.urdf",
        "joint 1: turn, revolute",
        "joint 2: lift, revolute",
        "joint 3: slide, prismatic",
        "locked at zero: finger: prismatic",
        "locked at zero: thumb: prismatic, mimics finger",
    ]
    for line in (
        "#     thumb: prismatic, mimics finger",
        "# column",
        "# arm, sensor",
        "# beam, tool, left, right",
    ):
        assert f"\n{line}\n" in text  # links that move with one joint
    turn, slide = robot.joints[0], robot.joints[2]
    assert (robot.name, turn.si("position")) == ("made up", pytest.approx((-2, 1.5), rel=1e-9))
    assert (turn.si("speed"), turn.effort_nm) == pytest.approx((3, 40), rel=1e-9)
    assert (slide.si("position"), slide.si("speed"), slide.effort_n) == ((0.1, 0.4), 0.5, 90)
    assert (robot.parameters["Fv1"], robot.parameters["Fc1"]) == (0.6, 0.25)
    # beam, tool, finger, thumb
    assert robot.parameters["M3"] == pytest.approx(0.7 + 0.3 + 0.1 + 0.1)
    assert (turn.acceleration_deg_s2, turn.following_error_deg, robot.controller.bandwidth_hz) == (
        None,
        None,
        None,
    )
    marked = [line for line in text.splitlines()[1:] if "FILL IN" in line]
    assert all(line.startswith("#") for line in marked)
    for key in (
        "acceleration_deg_s2",
        "acceleration_m_s2",
        "following_error_deg",
        "bandwidth_hz",
        "drives",
    ):
        assert any(key in line for line in marked), key
    assert out.splitlines()[-4] == f"to be filled in: {len(marked)} lines with FILL IN"


@pytest.mark.parametrize(
    ("given", "fit", "motors", "move"),
    [
        # counted by hand: range and speed (of --dh), acceleration, following error of each joint;
        # ratios, gains; what is said of the drives
        ("arm.urdf", 0, 1, 3 * 2 + 1 + 1),
        ("arm.urdf --effort A", 0, 3, 3 * 2 + 3 * 2 + 1),
        ("arm.urdf --effort A --ratio 9,9,8", 0, 0, 3 * 2 + 3 + 1),
        ("arm.urdf --effort A --ratio 9,9,8 --drive-gain 1,1,2", 0, 0, 3 * 2 + 1),
        ("arm.urdf --torque-sensor --effort N_m", 0, 0, 3 * 2 + 1),
        ("arm.urdf --joints turn,lift --bus bus.toml", 0, 2, 2 * 2 + 2 + 5),
        (" ".join(["arm.urdf", "--effort N_m", *STATED]), 0, 3, 3 + 1),
        ("--dh RRP", 3, 1, 3 * 4 + 1 + 1),
        ("--dh RR --bus bus.toml", 2, 2, 2 * 4 + 2 + 5),
    ],
)
def test_lines_marked_by_what_needs_them(here, capsys, given, fit, motors, move):
    """Of a log with efforts of the joints nothing is needed; dimensions if there is no URDF."""
    (here / "bus.toml").write_text(BUS)
    words = [word.replace("_", " ") for word in given.split()]
    status, out, _ = run(capsys, "init", *words, "-o", "robot.toml")
    assert status == 0
    text = (here / "robot.toml").read_text().splitlines()
    told = dict[str, list[str]]()
    for line in out.splitlines()[-3:]:
        use, numbers = line.removeprefix("of these, lines needed ").split(": ")
        told[use] = [text[int(k) - 1] for k in numbers.split(", ") if k != "none"]
    assert {use: len(lines) for use, lines in told.items()} == {
        "to fit": fit, "to fit efforts of motors": motors, "to move": move
    }  # fmt: skip
    assert all("FILL IN" in line for lines in told.values() for line in lines)
    assert all(line.startswith("dh = ") for line in told["to fit"])
    if "--bus" not in words:
        assert load_robot("robot.toml").n == 3  # it loads as it is


BUS = """[bus]
interface = "virtual"
channel = "made_up"
sync_period_s = 0.002 # FILL IN: the period
""" + "".join(f"""
[[bus.drive]] # FILL IN: which joint?
node = {node}
reference = "6074"
rated_torque_nm = 4.2
counts_per_turn = {1000 * node} # FILL IN: turn the motor once
""" for node in (7, 3))  # fmt: skip


def test_scanned_bus_replaces_example_drives(here, capsys):
    (here / "bus.toml").write_text(BUS)
    out = ["init", "arm.urdf", "--joints", "turn,lift", "--bus", "bus.toml", "-o", "robot.toml"]
    status, printed, _ = run(capsys, *out)
    text, robot = (here / "robot.toml").read_text(), load_robot("robot.toml")
    assert status == 0
    assert [(d.node, d.counts_per_turn) for d in resolve(robot, "robot.toml").file.drive] == [
        (7, 7000),
        (3, 3000),
    ]
    assert "#: [bus]" not in text
    marked = [number for number, line in enumerate(text.splitlines(), 1) if "FILL IN" in line]
    lines = {number: text.splitlines()[number - 1] for number in lines_to_fill_in(robot)}
    assert list(lines)[-5:] == marked[-5:]
    of_motion = ["# acceleration_deg_s2", "# following_error_deg"]
    keys = [line.partition(" = ")[0] for line in lines.values()]
    assert keys[:-5] == [*of_motion, *of_motion, "# ratio", "# ratio"]
    # 6074h is per mille of the rated torque
    assert [motor.effort_unit for motor in robot.motors] == ["N m", "N m"]
    assert len(marked) > 10
    # the first line says what the mark means
    assert f"to be filled in: {len(marked) - 1} lines" in printed


def test_existing_file_kept_urdf_found_from_output(here, capsys):
    (here / "bus.toml").write_text(BUS)
    said = refused(capsys, "init", "arm.urdf", "--bus", "bus.toml", "-o", "robot.toml")
    assert said == "bus.toml: drives = 2: expected 3, one [[bus.drive]] for each joint of the URDF"
    assert not (here / "robot.toml").exists()
    (here / "robot.toml").write_text("mine")
    said = refused(capsys, "init", "arm.urdf", "-o", "robot.toml", "--overwrite")
    assert said.startswith(
        "robot.toml: the file already exists and is a file of another kind, not a robot"
    )
    mine = '[[joint]]\nname = "mine"\n'
    (here / "robot.toml").write_text(mine)
    said = refused(capsys, "init", "arm.urdf", "-o", "robot.toml")
    assert said == "robot.toml: already exists. Choose a new name, or add --overwrite."
    assert (here / "robot.toml").read_text() == mine
    for out in (["--bus", "bus.toml", "-o", "bus.toml"], ["-o", "arm.urdf"]):
        assert "the output is also an input" in refused(capsys, "init", "arm.urdf", *out)
    (here / "cell").mkdir()
    assert run(capsys, "init", "arm.urdf", "-o", "cell/robot.toml")[0] == 0
    assert load_robot("cell/robot.toml").n == 3
    options = ["--effort", "N m", "--torque-sensor", "--overwrite", "-o", "robot.toml"]
    status, out, _ = run(capsys, "init", "arm.urdf", *options)
    assert (status, load_robot("robot.toml").joints[0].rotor_inertia) == (0, False)
    assert (
        "rotor_inertia = false, because torque sensors do not measure rotors; the torque of a "
        "motor would include its rotor" in out
    )


def test_example_drives_are_valid(here, capsys):
    """Without the mark of its lines: a description whose simulated drives can
    be resolved and moved.
    """
    assert run(capsys, "init", "arm.urdf", *NAMES, *STATED, "-o", "robot.toml")[0] == 0
    (here / "cell.toml").write_text((here / "robot.toml").read_text().replace("\n#: ", "\n"))
    robot = load_robot("cell.toml")
    assert robot.parameters["Fv1"] == 0.6  # stated by the URDF; others are made up, for all joints
    assert {
        f"{name}{j}" for name in ("Ia", "Fv", "Fc") for j in (1, 2, 3)
    } <= robot.parameters.keys()
    assert "Ia1" not in load_robot("robot.toml").parameters
    bus = resolve(robot, "cell.toml")
    assert [drive.node for drive in bus.drives] == [1, 2, 3]
    assert driven_plant(robot, bus).warning is None
    middle = np.array([np.mean(j.si("position")) for j in robot.joints])
    check_limits(np.tile(middle, (3, 1)), robot, 0.002, "nowhere")


@pytest.mark.parametrize("n", [1, 7, 8, 11, 15])
def test_example_can_frames_fit_sync_period(tmp_path, capsys, n):
    """As a session that sends asks for it, which names the shortest period to two digits; 2 ms
    where that is enough.
    """
    parts = [link("l0"), *(link(f"l{k}") for k in range(1, n + 1))]
    parts += [joint(f"j{k}", "revolute", f"l{k - 1}", f"l{k}", LIMIT) for k in range(1, n + 1)]
    (tmp_path / "long.urdf").write_text(f'<robot name="long">{"".join(parts)}</robot>')
    out = tmp_path / "robot.toml"
    assert run(capsys, "init", tmp_path / "long.urdf", "-o", out)[0] == 0
    out.write_text(out.read_text().replace("\n#: ", "\n"))
    bus = resolve(load_robot(out), str(out))
    refuse_load(bus, "robot.toml")
    assert bus.file.sync_period_s == 0.002 or bus.load > 0.8


def test_missing_limits_from_options_or_named(here, capsys):
    """No range of 1 rad: a continuous joint, one without <limit>, one whose limits are equal."""
    equal = LIMIT.replace("-2", "0").replace("1.5", "0")
    for kind, limit in (
        ("continuous", ""),
        ("revolute", ""),
        ("continuous", LIMIT),
        ("revolute", equal),
    ):
        (here / "arm.urdf").write_text(urdf(turn=joint("turn", kind, "base", "column", limit)))
        assert (
            "# position_deg = [LOWEST, HIGHEST] # FILL IN"
            in run(capsys, "init", "arm.urdf", *NAMES)[1]
        )
        if limit:
            continue
        assert run(capsys, "init", "arm.urdf", *NAMES, *STATED, "-o", f"{kind}.toml")[0] == 0
        assert "# speed_deg_s = ... # FILL IN" in (here / f"{kind}.toml").read_text()
        error = refused(capsys, "study", f"{kind}.toml", "--runs", "1")
        assert "joint turn: joint[0].position_deg is missing. Give [lowest, highest]" in error
        of_range = [
            *NAMES,
            *STATED,
            "--range",
            "3,3,0.3",
            "--speed",
            "2,2,0.2",
            "-o",
            f"{kind}_moves.toml",
        ]
        assert run(capsys, "init", "arm.urdf", *of_range)[0] == 0
        limits = load_robot(f"{kind}_moves.toml").joints[0]
        assert (limits.si("position"), limits.si("speed")) == (
            pytest.approx((-3, 3)),
            pytest.approx(2),
        )


def test_options_and_urdf_limits_combine(here):
    """The narrower range, the smaller speed; one value holds for all joints of one kind, one
    bandwidth for the robot.
    """
    stated = {
        "position": (1.0, 3.0, 0.3),
        "speed": (2.0, 5.0, 0.2),
        "acceleration": (8.0, 9.0, 2.0),
    }
    stated["bandwidth_hz"] = (6.0, 5.0, 7.0)
    robot = robot_of_chain(read_chain(Path("arm.urdf"), ARM).with_values(stated))
    assert [j.si("position") for j in robot.joints] == [
        pytest.approx(x) for x in ((-1, 1), (-2, 1.5), (0.1, 0.3))
    ]
    assert [j.si("speed") for j in robot.joints] == pytest.approx([2, 3, 0.2])
    assert [j.si("acceleration") for j in robot.joints] == pytest.approx([8, 9, 2])
    assert robot.bandwidth_hz == 5.0
    pair = read_chain(Path("arm.urdf"), ("turn", "lift"))
    assert [j.acceleration for j in pair.with_values({"acceleration": (4.0,)}).joints] == [
        4.0,
        4.0,
    ]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            "--acceleration 1,2",
            "--acceleration = 2 values: expected 1 value, or 3 for turn, lift, slide",
        ),
        (
            "--speed 1",
            "--speed = 1.0: one value cannot be in rad for some joints and in m for others. Give 3 "
            "values.",
        ),
        (
            "--range 1,1,0.1",
            "--range = 0.1: does not overlap the limits of joint 'slide' in arm.urdf: 0.1 to 0.4 m",
        ),
        (
            "--joints turn,elbow",
            "--joints = 'elbow': expected turn, lift, slide, finger, each at most once",
        ),
        ("--joints turn,thumb", "--joints = 'thumb': expected turn, lift"),
        ("--joints lift,turn", "order of joints = lift, turn: expected turn, lift"),
    ],
)
def test_unsuitable_options_refused(here, capsys, given, message):
    assert message in refused(capsys, "init", "arm.urdf", *NAMES, *given.split())


def test_urdf_values_refused_with_description(here, capsys):
    run(capsys, "init", "arm.urdf", *NAMES, "-o", "robot.toml")
    with pytest.raises(
        RobotIdimError, match=r"^bandwidth_hz: applies to a URDF only. Set it in robot\.toml"
    ):
        read_robot("robot.toml", bandwidth_hz=5.0)
    error = refused(capsys, "study", "robot.toml")
    assert error.startswith("robot made up: controller.bandwidth_hz is missing. Give the bandwidth")


def massless(name):
    return f'<link name="{name}"/>\n'


def turn(rest=LIMIT, kind="revolute", parent="base", name="turn", axis="0 0 1"):
    return urdf(turn=joint(name, kind, parent, "column", rest, axis))


RING = link("x") + link("y") + joint("xy", "fixed", "x", "y") + joint("yx", "fixed", "y", "x")
STIFF = (
    f'<robot name="r">{PARTS["base"]}{PARTS["beam"]}{joint("j", "fixed", "base", "beam")}</robot>'
)
UNKNOWN = urdf(turn='<joint name="turn" type="fixed"><child link="column"/></joint>')
XACRO = '<xacro:macro xmlns:xacro="http://www.ros.org/wiki/xacro"/>'
FLOATING = urdf(mid=joint("swing", "floating", "column", "arm"), lift="")
TWO_CHAINS = urdf(extra=link("mast") + joint("sway", "revolute", "arm", "mast"))
BETWEEN = "between the base and joint 'slide': type = "
AGAIN = "joint 'again': child = 'tool': is the child of joint 'mount' too. Give each"
BAD = (
    ("<robot", "is not XML: "),
    ("<sdf/>", "root element = <sdf>: expected <robot>"),
    ('<robot name="x"/>', "has no link. Add its links and joints."),
    (urdf(base=XACRO), "has xacro elements. Convert it first: `xacro FILE > robot.urdf`."),
    (urdf(extra=link("island")), "has 2 root links: base, island. Give it one base link"),
    (
        urdf(extra=joint("back", "fixed", "tool", "base")),
        "has no root link, since its joints form a loop. Give it one base link",
    ),
    (urdf(extra=RING), "links x, y are in a loop of joints. Break the loop"),
    (urdf(extra=joint("again", "fixed", "base", "tool")), AGAIN),
    (
        turn(parent="floor"),
        "joint 'turn': parent = 'floor': expected one of the links base, column",
    ),
    (UNKNOWN, "joint 'turn': parent is missing: expected one of the links"),
    (urdf(extra=link("base")), "link 9: name = 'base': is used twice. Give each link a name"),
    (urdf(extra="<link/>"), "link 9: name is missing. Give each link a name"),
    (
        turn(kind="ball"),
        "type = 'ball': expected one of revolute, continuous, prismatic, fixed, floating, planar",
    ),
    (FLOATING, f"joint 'swing', {BETWEEN}'floating': expected fixed, revolute"),
    (STIFF, "has no movable joint: expected joints of type revolute, continuous, prismatic"),
    (
        TWO_CHAINS,
        "3 joints each, which end at slide, sway. Name the joints of one chain (--joints).",
    ),
    (
        turn('<limit lower="1" upper="-1"/>'),
        "joint 'turn': limit lower = 1.0: expected at most upper = -1",
    ),
    (
        turn('<limit lower="low" upper="-1"/>'),
        "joint 'turn': limit lower = 'low': expected a finite number",
    ),
    (
        turn('<limit velocity="-1"/>'),
        "joint 'turn': limit velocity = -1.0: expected 0 or greater",
    ),
    (
        turn('<dynamics damping="-0.1"/>'),
        "joint 'turn': dynamics damping = -0.1: expected 0 or greater",
    ),
    (turn(axis="0 0 0"), "joint 'turn': axis = '0 0 0': expected a vector other than zero"),
    (turn(name="a/b"), "name of a joint = 'a/b': expected 1 to 64 letters"),
    (
        urdf(arm=link("arm", inertia="")),
        "link 'arm': inertia ixx is missing: expected a finite number",
    ),
)


@pytest.mark.parametrize(("text", "message"), BAD, ids=[message for _, message in BAD])
def test_bad_urdf_refused(here, capsys, text, message):
    (here / "arm.urdf").write_text(text)
    said = refused(capsys, "init", "arm.urdf", "-o", "robot.toml")
    assert said.startswith(("arm.urdf: ", "robot made up: URDF: "))
    assert message in said
    assert not (here / "robot.toml").exists()


def test_missing_and_binary_files_refused(here, capsys):
    assert (
        refused(capsys, "init", "none.urdf")
        == "none.urdf: the file cannot be read: No such file or directory"
    )
    (here / "arm.urdf").write_bytes(bytes(range(256)))
    assert "arm.urdf: is not XML" in refused(capsys, "init", "arm.urdf")


def test_massless_link_merged_into_body(here, capsys):
    """A joint may move a link without mass if another is fixed to it: they are one body."""
    (here / "arm.urdf").write_text(urdf(arm=massless("arm"), sensor=link("sensor", mass=0.4)))
    assert run(capsys, "init", "arm.urdf", "-o", "robot.toml")[0] == 0
    assert load_robot("robot.toml").parameters["M2"] == pytest.approx(0.4)


def bare(text, but=""):
    """The URDF without inertials, as many models for drawing are; but of one link."""
    return re.sub(f'(?s)(?<!<link name="{but}">)<inertial>.*?</inertial>', "", text)


NEGATIVE = BOX.replace("0.03", "-0.03")
LACKING = [
    (bare(urdf()), "no mass moves with turn, lift, slide"),
    (bare(urdf(), but="base"), "no mass moves with turn, lift, slide"),
    (bare(urdf(), but="tool"), "no mass moves with turn, lift"),
    (re.sub('mass value="[^"]*"', 'mass value="0"', urdf()), "no mass moves with turn, lift, sl"),
    (urdf(arm=massless("arm")), "no mass moves with lift"),
    (urdf(arm=link("arm", mass=-1)), "link arm has mass -1 kg, principal moments 0.0199, "),
    (urdf(arm=link("arm", inertia=NEGATIVE)), "link arm has mass 2 kg, principal moments -0.0300"),
    (
        urdf(arm=massless("arm"), column=link("column", inertia=BOX.replace("0.001", "0.1"))),
        "no mass moves with lift, link column has mass 2 kg, principal moments -0.07",
    ),
]  # fmt: skip


@pytest.mark.parametrize(("text", "why"), LACKING)
def test_no_inertials_no_a_priori_values(here, capsys, text, why):
    """A fit needs the geometry alone. A mass or moment below zero, or a link that was forgotten,
    would be simulated, and compared with a fit, as if it were the robot's.
    """
    (here / "arm.urdf").write_text(text)
    status, out, err = run(capsys, "init", "arm.urdf", *NAMES, *STATED, "-o", "robot.toml")
    assert (status, err) == (0, "")
    note = f"note: no [parameters], which simulations need and fits do not: {why}"
    for written in (out, (here / "robot.toml").read_text()):
        (line,) = (one for one in written.splitlines() if "[parameters]" in one)
        assert line.removeprefix("# ").startswith(note)
    robot = load_robot("robot.toml")
    assert (dict(robot.parameters), robot.n) == ({}, 3)
    direct = read_robot("arm.urdf", joints=ARM, acceleration=(8, 8, 2), bandwidth_hz=5)
    assert (dict(direct.parameters), direct.n) == ({}, 3)
    (here / "cell.toml").write_text((here / "robot.toml").read_text().replace("\n#: ", "\n"))
    cell = load_robot("cell.toml")
    assert "no [parameters]" in driven_plant(cell, resolve(cell, "cell.toml")).warning
    for command in (["study", "robot.toml", "--runs", "1"], ["simulate", "robot.toml", "-o", "a"]):
        assert "has no [parameters], which simulations need. Write" in refused(capsys, *command)


@pytest.mark.parametrize("text", [bare(urdf()), urdf(arm=link("arm", mass=-1))])
def test_urdf_without_inertials_fitted_and_exported(here, capsys, text):
    """The recording is pinocchio's torque of the whole URDF; the exported URDF needs the same at
    states that were not recorded.
    """
    (here / "arm.urdf").write_text(text)
    options = [*NAMES, *STATED, "--effort", "N m", "--torque-sensor", "-o", "robot.toml"]
    assert run(capsys, "init", "arm.urdf", *options)[0] == 0
    draw, w = np.random.default_rng(5), 2 * np.pi * np.array([0.1, 0.2, 0.3, 0.5])
    # within the limits: 0.8 rad, 0.14 m about the middle of the slide
    size = np.array([0.8, 0.8, 0.14]) * draw.dirichlet(np.ones(4), 3).T
    waves = size * np.exp(
        1j * (np.arange(2000)[:, None, None] / 200 * w[:, None] + draw.normal(scale=9, size=(4, 3)))
    )
    q, dq, ddq = ((waves * (1j * w[:, None]) ** k).sum(axis=1).imag for k in range(3))
    q += [0, 0, 0.25]
    tau = torque_of_the_urdf(urdf(), ARM, (q, dq, ddq)) + 2 * dq + 0.5 * np.sign(dq)
    tau += 1e-3 * tau.std(axis=0) * draw.normal(size=tau.shape)
    found = fit(q, tau, 200.0, "robot.toml")
    found.consistent().export(urdf="new.urdf", mjcf="new.xml", toml="new.toml")
    others = draw.normal(size=(3, 30, 3))
    true, exported = (
        torque_of_the_urdf(one, ARM, others) for one in (urdf(), Path("new.urdf").read_text())
    )
    error = np.linalg.norm(exported - true, axis=0) / np.linalg.norm(true, axis=0)
    assert error.max() < 0.01
    assert mujoco.MjModel.from_xml_path("new.xml").nv == 3
    assert run(capsys, "simulate", "new.toml", "-o", "new.mcap", "--duration-s", "2")[0] == 0


FLAT = '<inertia ixx="0.02" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.06"/>'
LOCKED = (
    joint("flap", "floating", "base", "x")
    + joint("crank", "planar", "x", "y")
    + link("x")
    + link("y")
)


@pytest.mark.parametrize(
    ("changes", "options", "noted"),
    [
        (
            {"arm": link("arm", inertia=FLAT)}, [],  # used as they are
            ["# note: link arm has impossible principal moments 0.02, 0.03, 0.06 kg m²: one "
             "exceeds the sum of the others"],
        ),
        (
            # no axis needed
            {"off": LOCKED, "finger": joint("finger", "revolute", "tool", "left", axis="0 0 0")},
            NAMES,
            ["#     flap: floating", "#     crank: planar", "#     finger: revolute"],
        ),
        # Two fingers that mimic nothing would be two chains of one length.
        (
            {"thumb": joint("right_finger", "prismatic", "tool", "right")}, [],
            ["#     finger: prismatic", "#     right_finger: prismatic"],
        ),
    ],
)  # fmt: skip
def test_odd_and_locked_joints_noted(here, capsys, changes, options, noted):
    (here / "arm.urdf").write_text(urdf(**changes))
    status, out, _ = run(capsys, "init", "arm.urdf", *options)
    assert status == 0
    assert all(f"{line}\n" in out for line in noted)


@pytest.mark.parametrize(
    ("given", "motors", "to_fill_in"),
    [
        ("A --ratio=-101,50,8 --drive-gain 0.1,0.2,3",
         [("N m/A", -101, 0.1), ("N m/A", 50, 0.2), ("N/A", 8, 3)], ()),
        ("A --ratio 9,9,8", [{"ratio": r, "effort_unit": "A"} for r in (9, 9, 8)], ("drive_gain",)),
        ("% --ratio 9,9,8 --drive-gain 1,1,2", [("N m/%", 9, 1), ("N m/%", 9, 1), ("N/%", 8, 2)],
         ()),
        ("N_m --ratio 9,9,8", [{"ratio": r, "effort_unit": u} for r,
                               u in ((9, "N m"), (9, "N m"), (8, "N"))], ()),
        ("N_m", [{"effort_unit": u} for u in ("N m", "N m", "N")], ("ratio",)),
        ("N_m --torque-sensor", [{"effort_unit": u} for u in ("N m", "N m", "N")], ()),
    ],
)  # fmt: skip
def test_unit_motor_values_by_options_only(here, capsys, given, motors, to_fill_in):
    """A gain without its ratio has no effect: it would scale all values by the ratio."""
    command = ["init", "arm.urdf", "--effort", *(word.replace("_", " ") for word in given.split())]
    assert run(capsys, *command, "-o", "robot.toml")[0] == 0
    text = (here / "robot.toml").read_text()
    keys = "drive_gain_unit", "ratio", "drive_gain"
    expected = [x if isinstance(x, dict) else dict(zip(keys, x, strict=True)) for x in motors]
    found = tomllib.loads(text)["motor"]
    assert [{k: v for k, v in motor.items() if k != "name"} for motor in found] == expected
    marked = {line[2:].split(" = ")[0] for line in text.splitlines() if "FILL IN" in line} & {
        "ratio",
        "drive_gain",
    }
    assert marked == set(to_fill_in)
    robot = load_robot("robot.toml")
    assert [joint.rotor_inertia for joint in robot.joints] == ["torque-sensor" not in given] * 3
    assert ("#: Ia1" in text) == ("torque-sensor" not in given)


def test_conflicting_motor_options_refused(here, capsys):
    for given, key in (
        (["--ratio", "9"], "--ratio"),
        (["--effort", "N m", "--drive-gain", "1"], "--drive-gain"),
        (["--effort", "A", "--torque-sensor"], "--torque-sensor"),
        (["--effort", "N m", "--torque-sensor", "--ratio", "9"], "--ratio"),
    ):
        assert refused(capsys, "init", "arm.urdf", *given).startswith(f"{key} = ")
    wrong = refused(capsys, "init", "arm.urdf", "--effort", "A", "--ratio", "1,2")
    assert "--ratio = 2 values: expected 1 value, or 3 for turn, lift, slide" in wrong
