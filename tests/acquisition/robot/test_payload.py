"""The payload: its text, `[payload]` of robot.toml, and its parameters in the
frame of the last link.
"""

import contextlib
import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from conftest import REPLAY, robot_named
from made_up_bags import bag, message
from made_up_buses import bus_text, flat, robot_of, session
from made_up_recordings import header, some_samples
from urdfs import ARM, joint, urdf

from acquisition.bus import Frame
from acquisition.commands import main
from acquisition.errors import BadInputError, RobotIdimError
from acquisition.importing import BagOptions, import_bag, import_recording, import_tables
from acquisition.options import RecordOptions
from acquisition.recording import SENT, RecordingWriter, read_recording
from acquisition.robot import Payload, Robot, load_robot, parse_payload, robot_from_files
from acquisition.session import ProcessLog, Role, UserInterface, record
from identification.model import InverseModel, payload_parameters
from identification.simulation import described_robot

TX40 = (REPLAY / "tx40" / "robot.toml").read_text()
BAG = BagOptions(topic="/joint_states", effort_unit=["N m"])
MOUNT = {"mount": joint("mount", "fixed", "beam", "tool", origin="0.05 0.1 0.3")}


def arm(table: str = "", **parts: str) -> Robot:
    """The URDF of three joints with a tool fixed to the last link, and a sensor
    fixed to the link before.
    """
    kinds = ("revolute", "revolute", "prismatic")
    joints = "".join(
        f'[[joint]]\nname = "{name}"\ntype = "{kind}"\n'
        for name, kind in zip(ARM, kinds, strict=True)
    )
    motors = "".join(f'[[motor]]\nname = "m_{name}"\neffort_unit = "N m"\n' for name in ARM)
    text = f'name = "arm"\nurdf = "r.urdf"\n{joints}{motors}[controller]\nbandwidth_hz = 5\n{table}'
    return robot_from_files(
        {"robot.toml": text.encode(), "robot.urdf": urdf(**(MOUNT | parts)).encode()}, "arm.toml"
    )


@pytest.mark.parametrize(
    ("text", "payload", "words"),
    [
        ("2.805", Payload(2.805), "2.805 kg, centre of mass not given"),
        (
            "2.805@0.03,0.15,-0.16",
            Payload(2.805, (0.03, 0.15, -0.16)),
            "2.805 kg at 0.03, 0.15, -0.16 ± 0.005 m in",
        ),
        (" 1e-3 @ 0, 0 ,5", Payload(0.001, (0.0, 0.0, 5.0)), "0.001 kg at 0, 0, 5 ± 0.005 m in"),
        (
            "2@0,0,0.1+-1e-3",
            Payload(2.0, (0.0, 0.0, 0.1), center_half_width_m=0.001),
            "2 kg at 0, 0, 0.1 ± 0.001 m in",
        ),
        (f"{1 / 3!r}@{0.1 + 0.2!r},0,0", Payload(1 / 3, (0.1 + 0.2, 0.0, 0.0)), None),
    ],
)
def test_payload_is_read_and_written(text, payload, words):
    found = parse_payload(text, robot_named("tx40"))
    assert found == payload
    assert parse_payload(found.text, robot_named("tx40")) == payload
    assert words is None or str(found) == words + " the frame of the last joint" * words.endswith(
        "in"
    )


@pytest.mark.parametrize(
    "text",
    [
        *("", "x", "0", "-1", "nan", "1e7", "2,805", "2+-0.1", "@0,0,0"),
        *(
            "2@",
            "2@1,2",
            "2@0,0,0,0",
            "2@0,0,nan",
            "2@0,0,5.001",
            "2@0,-5.1,0",
            "2@0@0",
            "2@0,0,0.1+-x",
            "2@0,0,0.1+--1",
        ),
    ],
)
def test_no_payload(text):
    with pytest.raises(BadInputError) as refused:
        parse_payload(text, robot_named("tx40"))
    assert (refused.value.key, refused.value.value) == ("payload", text)
    assert refused.value.expected.startswith("KG or KG@X,Y,Z")


def test_payload_table_sets_frame_and_half_widths():
    robot = arm(
        '[payload]\nframe = "tool"\nmass_half_width_kg = 0.01\ncenter_half_width_m = 0.002\n'
    )
    assert parse_payload("2@0,0,0.1", robot) == Payload(2.0, (0.0, 0.0, 0.1), "tool", 0.01, 0.002)
    assert parse_payload("2@0,0,0.1+-0.003", robot).center_half_width_m == 0.003
    assert str(parse_payload("2@0,0,0.1", robot)) == "2 ± 0.01 kg at 0, 0, 0.1 ± 0.002 m in tool"


def refusal(call, *arguments, **named) -> tuple[str, str, object]:
    with pytest.raises((BadInputError, RobotIdimError)) as caught:
        call(*arguments, **named)
    return caught.value.place, caught.value.key, caught.value.value


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [
        ('frame = "tool0"', "payload.frame", "tool0"),
        ("mass_half_width_kg = -1", "payload.mass_half_width_kg", -1),
        ("center_half_width_m = -1", "payload.center_half_width_m", -1),
        ("mass = 2", "payload", None),
    ],
)
def test_invalid_payload_table_is_refused(table, key, value):
    files = {"robot.toml": f"{TX40}\n[payload]\n{table}\n".encode()}
    assert refusal(robot_from_files, files, "robot.toml") == ("robot.toml", key, value)
    if value == "tool0":
        assert refusal(arm, f"[payload]\n{table}\n") == ("arm.toml", key, value)


def test_payloads_without_parameters_or_unit():
    assert refusal(payload_parameters, InverseModel(arm()), Payload(None))[1] == "payload"
    motors = tuple(msgspec.structs.replace(m, effort_unit="A") for m in arm().motors)
    in_amperes = replace(arm(), motors=motors, parameters={"M1": 1.0})
    assert refusal(described_robot, in_amperes, Payload(1.0))[:2] == ("robot arm", "payload")
    robot = replace(
        arm(), parameters={"M1": 1.0, "XX1": 1.0, "YY1": 1.0, "ZZ1": 1.0, "M2": 1.0, "M3": 1.0}
    )
    assert refusal(described_robot, robot, Payload(1.0, frame="sensor"))[1:] == (
        "payload.frame",
        "sensor",
    )


def test_ball_parameters_by_hand():
    """2 kg at (0.1, 0, 0.3) m of the last joint: J = 2/5 m r² E + m (c·c E − c cᵀ) about
    the origin of its frame.
    """
    J = 0.4 * 2 * 0.1**2
    expected = [J + 2 * 0.09, 0.0, -2 * 0.03, J + 2 * 0.1, 0.0, J + 2 * 0.01, 0.2, 0.0, 0.6, 2.0]
    for robot in (robot_named("tx40"), arm()):
        found = payload_parameters(InverseModel(robot), Payload(2.0, (0.1, 0.0, 0.3)))
        np.testing.assert_allclose(found, expected, atol=1e-15)


def test_fixed_link_frame_gives_its_parameters():
    """pinocchio merges a tool with this mass and inertia into the last link: the payload in
    its frame adds the same.
    """
    J = 0.4 * 2 * 0.1**2
    ball = f'<inertia ixx="{J}" ixy="0" ixz="0" iyy="{J}" iyz="0" izz="{J}"/>'
    body = (
        '<link name="tool"><inertial><origin xyz="0.02 -0.1 0.3"/><mass '
        f'value="2"/>{ball}</inertial></link>'
    )
    robots = [arm(tool='<link name="tool"/>'), arm(tool=body)]
    empty, full = (InverseModel(robot).link_parameters()[-1] for robot in robots)
    found = payload_parameters(InverseModel(robots[0]), Payload(2.0, (0.02, -0.1, 0.3), "tool"))
    np.testing.assert_allclose(found, full - empty, atol=1e-12)
    at_origin = payload_parameters(InverseModel(robots[0]), Payload(2.0, frame="tool"))
    np.testing.assert_allclose(at_origin[6:], 2 * np.array([0.05, 0.1, 0.3, 1.0]), atol=1e-12)


@pytest.mark.parametrize("frame", ["sensor", "arm", "base", "mount", "nothing"])
def test_frame_before_last_joint_is_refused(frame):
    told = refusal(payload_parameters, InverseModel(arm()), Payload(2.0, frame=frame))
    assert told == ("robot arm", "payload.frame", frame)


HEAVY = Payload(2.805, (0.03, 0.15, -0.16), None, 0.01)


def recorded(path: Path, payload: Payload | None, /, **metadata: str) -> Path:
    with RecordingWriter(
        path, replace(header(robot_named("scara")), payload=payload, notes=metadata)
    ) as writer:
        writer.samples(some_samples(100))
    return path


def test_payload_of_later_version_is_read(tmp_path):
    text = '{"mass_kg": 2, "inertia_kg_m2": [1, 2, 3], "center_of_mass_m": [0, 0, 1]}'
    path, cut = recorded(tmp_path / "a.mcap", None, payload=text), tmp_path / "cut.mcap"
    assert read_recording(path).payload == Payload(2.0, (0.0, 0.0, 1.0))
    cut.write_bytes(path.read_bytes()[:-300])
    again = read_recording(import_recording(cut, tmp_path / "b.mcap").out)
    assert (again.metadata["payload"], again.payload) == (text, Payload(2.0, (0.0, 0.0, 1.0)))


@pytest.mark.parametrize(
    "text",
    [
        *(
            "",
            "2.805",
            "{}",
            '{"mass_kg": 0}',
            '{"mass_kg": 1e999}',
            '{"mass_kg": 2, "mass_half_width_kg": -1}',
        ),
        '{"mass_kg": 2, "x": ' + "[" * 9999,
    ],
)
def test_recording_with_invalid_payload_is_refused(tmp_path, text):
    path = recorded(tmp_path / "a.mcap", None, payload=text)
    assert refusal(read_recording, path) == (str(path), "payload", text)


def test_decoding_again_keeps_payload(tmp_path):
    dry, again, options = (
        tmp_path / "dry.mcap",
        tmp_path / "again.mcap",
        {"dry_run": True, "duration_s": 0.2},
    )
    record(
        robot_of(bus_text(2)),
        "robot.toml",
        dry,
        RecordOptions(payload="2@0,0,0.1", **options),
        UserInterface(),
    )
    import_recording(dry, again, robot_of(bus_text(2, ratio=60.0)), "robot.toml")
    assert (
        read_recording(again).payload
        == read_recording(dry).payload
        == Payload(2.0, (0.0, 0.0, 0.1))
    )


def test_info_shows_payload(tmp_path, capsys):
    words = "2.805 ± 0.01 kg at 0.03, 0.15, -0.16 ± 0.005 m in the frame of elbow"
    log = str(recorded(tmp_path / "a.mcap", HEAVY))
    assert main(["info", log]) == main(["info", log, "--json"]) == 0
    shown, _, found = capsys.readouterr().out.partition("{")
    assert words in shown
    assert msgspec.convert(json.loads("{" + found)["payload"], Payload) == HEAVY


def test_imports_take_payload(tmp_path):
    carried, out, log = Payload(2.5, (0.0, 0.0, 0.1)), tmp_path / "out.mcap", tmp_path / "a.log"
    import_bag(
        bag(tmp_path / "bag", map(message, range(60))), robot_named("scara"), out, BAG, carried
    )
    assert read_recording(out).payload == carried
    rows = [
        f"({t * 1e-9:.6f}) can0 {i:03X}#{d.tobytes()[:k].hex().upper()}\n"
        for t, i, k, _, d in flat(session())
    ]
    log.write_text("".join(rows))
    np.savetxt(tmp_path / "a.csv", np.zeros((300, 4)), delimiter=",")
    table_map = (
        'sample_rate_hz = 1000\n[position]\ncolumns = [1, 2]\nunit = "rad"\n[effort]\ncolumns '
        '= [3, 4]\nunit = "N m"\n'
    )
    (tmp_path / "map.toml").write_text(table_map)
    out.unlink()
    import_tables([tmp_path / "a.csv"], robot_named("scara"), tmp_path / "map.toml", out, carried)
    assert read_recording(out).payload == carried
    command = [
        "import",
        str(log),
        "--robot",
        "robot.toml",
        "-o",
        str(out),
        "--overwrite",
        "--payload",
    ]
    (tmp_path / "robot.toml").write_text(bus_text(2))
    with contextlib.chdir(tmp_path):
        assert main([*command, "2@x"]) == 1
        assert main([*command, "2@0,0,0.1"]) == 0
    assert read_recording(out).payload == Payload(2.0, (0.0, 0.0, 0.1))


@pytest.mark.parametrize("command", ["record", "check"])
def test_commands_refuse_invalid_payload_first(tmp_path, command, capsys):
    toml, out = tmp_path / "robot.toml", tmp_path / "a.mcap"
    toml.write_text(bus_text(2))
    options = ["-o", str(out), "--duration", "0.1"] if command == "record" else []
    assert main([command, str(toml), "--payload", "2@0,0", *options]) == 1
    assert capsys.readouterr().err.startswith(
        "robot-acquire: --payload = '2@0,0': expected KG or KG@X,Y,Z"
    )
    assert not out.exists()
    if command == "check":
        assert main([command, str(toml), "--payload", "2@0,0,0.1"]) == 1  # no drive answers
        assert "ok      payload" in capsys.readouterr().out


def test_real_session_has_payload(tmp_path):
    robot = robot_of(bus_text(1, interface="udp_multicast", channel="239.74.163.9"))
    log = ProcessLog(
        tmp_path / "a.mcap", robot, "robot.toml", Role.FED, 0, Payload(2.0, (0.0, 0.0, 0.1))
    )
    try:
        log.tap(Frame(10**9, 0x80, b"", SENT))
        log.finish(10**9)
    finally:
        log.close()
    assert read_recording(tmp_path / "a.mcap").payload == Payload(2.0, (0.0, 0.0, 0.1))


def pendulum(folder: Path) -> Path:
    """One joint that turns about z, level, without friction, with gravity along -y; at
    rest it holds 3 N m cos q.
    """
    text = bus_text(1).replace("[controller]", "gravity_m_s2 = [0.0, -9.81, 0.0]\n[controller]")
    (folder / "robot.toml").write_text(f"{text}\n[parameters]\nZZ1 = 2.0\nMX1 = {3 / 9.81}\n")
    (folder / "ref.csv").write_text(
        "time_s,joint_1\n" + "".join(f"{0.002 * k},0\n" for k in range(150))
    )
    return folder / "robot.toml"


@pytest.mark.parametrize(
    ("payload", "torque_nm"), [(None, 3.0), ("1.5@0.4,0.3,-0.2", 3.0 + 1.5 * 9.81 * 0.4)]
)
def test_dry_run_carries_payload(tmp_path, capsys, payload, torque_nm):
    out = tmp_path / "a.mcap"
    command = [
        "record",
        str(pendulum(tmp_path)),
        "--track",
        str(tmp_path / "ref.csv"),
        "--dry-run",
        "--no-fit",
        "-o",
        str(out),
    ]
    assert main([*command, *([] if payload is None else ["--payload", payload])]) == 0
    said, recording = capsys.readouterr().err, read_recording(out)
    if payload is None:
        assert (said, recording.payload) == ("", None)
    else:
        assert said.startswith(
            f"payload {recording.payload.describe('joint_1')}: the limits of robot.toml ignore it"
        )
    stop_ns = next(e.stamp_ns for e in recording.events if e.text == "stop")
    still = recording.samples[recording.samples["stamp_ns"] < stop_ns][-50:]
    assert np.abs(still["position"]).max() < 0.02
    np.testing.assert_allclose(still["effort"].mean(), torque_nm, atol=0.1)


def test_dry_run_gains_are_of_unloaded_robot(tmp_path):
    """Real drives are not tuned again for a payload; its inertia, about its centre of mass
    too, is that of a ball.
    """
    robot = load_robot(pendulum(tmp_path))
    (plant, loops), (loaded, same) = (
        described_robot(robot),
        described_robot(robot, Payload(1.5, (0.4, 0.3, -0.2))),
    )
    np.testing.assert_array_equal(same.velocity, loops.velocity)
    torque, free = np.array([20.0]), np.zeros(1, bool)
    for each in (plant, loaded):
        each.step(torque, free, 1e-3)
    accelerations = np.array([each.state()[1][0] / 1e-3 for each in (plant, loaded)])
    inertia = 2.0 + 1.5 * 0.25 + 0.4 * 1.5 * 0.1**2
    np.testing.assert_allclose(
        accelerations, [17 / 2, (17 - 1.5 * 9.81 * 0.4) / inertia], rtol=2e-3
    )


def test_brake_holds_joint_while_others_move():
    """The elbow of the SCARA pushes the shoulder."""
    plant, _ = described_robot(robot_named("scara"))
    before, _ = plant.state()
    plant.step(np.array([0.0, 1.0]), np.array([True, False]), 0.02)
    shoulder, elbow = plant.state()[0] - before
    assert abs(shoulder) < 1e-9 < 1e-4 < elbow
