"""Extra objects in samples: their PDOs, names, units and scales, from frames to CSV; SYNC periods refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
from dry_sessions import dry_session, swing
from made_up_buses import block, bus_of, bus_text, flat, frame, robot_of, session

from acquisition.bus import WallClock, describe_step
from acquisition.errors import AcquisitionError
from acquisition.importing import export_csv, import_recording
from acquisition.recording import SENT, decode, overview, read_recording
from acquisition.robot import Robot, extra_columns
from acquisition.session import Recorder, Task

TEMPERATURE = '{ object = "2081:1", name = "temperature", scale = 0.1, unit = "degC" }'
EXTRA = f'extra = ["606C", "6077", {TEMPERATURE}, "2082"]\nobjects = {{ "2081:1" = "I16", "2082" = "U8" }}\nsign = -1\n'


def robot_with_extras(n: int = 1) -> Robot:
    return robot_of(bus_text(n, drive=EXTRA, ratio=1.0))


def frames_with_extras(syncs: int = 20) -> np.ndarray:
    """Drive 1 turns at 65536 counts/s and k counts more at SYNC k; torque 500 per mille; 25.3 degrees; 7."""
    rows = []
    for k in range(syncs):
        t = 1_000_000_000 + 2_000_000 * k
        rows += [
            frame(t, 0x80, flags=SENT),
            frame(t + 1, 0x181, struct.pack("<Hih", 0x1237, 100 * k, 10)),
            frame(t + 2, 0x281, struct.pack("<ihh", 65536 + k, 500, 253)),
            frame(t + 3, 0x381, b"\x07"),
        ]
    return block(rows)


def test_names_units_and_scales():
    robot = robot_with_extras()
    (drive,) = bus_of(robot).drives
    assert [[str(e) for e in pdo.entries] for pdo in drive.tpdos] == [
        ["6041:0", "6064:0", "6074:0"],
        ["606C:0", "6077:0", "2081:1"],
        ["2082:0"],
    ]
    assert [(c.motor, c.name, c.unit) for c in extra_columns(robot)] == [
        ("motor_1", "velocity", "rad/s"),
        ("motor_1", "torque", "N m"),
        ("motor_1", "temperature", "degC"),
        ("motor_1", "2082:0", ""),
    ]
    found = decode(frames_with_extras(), robot, bus_of(robot), "log").samples
    assert found["extra"][3].tolist() == pytest.approx(
        [-2 * np.pi * (65536 + 3) / 65536, -500e-3 * 0.42, 25.3, 7], rel=1e-12
    )


def test_a_drive_that_slides_has_metres_and_its_second_axis_the_same_names():
    text = bus_text(1, drive='extra = ["686C"]\nobjects = { "686C" = "I32" }', ratio=1.0)
    text = (
        text.replace("revolute", "prismatic").replace("_deg", "_m").replace("N m", "N").replace("alpha_m", "alpha_deg")
    )
    text = (
        text.replace("theta_m", "theta_deg")
        .replace("position_m_s", "position_m")
        .replace("counts_per_turn", "counts_per_m")
    )
    text = text.replace("rated_torque_nm = 0.42", 'rated_force_n = 100\nreference_rule = "per mille of rated force"')
    (column,) = extra_columns(robot_of(text))
    assert (column.name, column.unit) == ("velocity", "m/s")
    (other,) = extra_columns(robot_of(text.replace("686C", "646C")))
    assert (other.name, other.unit) == ("646C:0", "")


@pytest.mark.parametrize(
    ("drive", "expected"),
    [
        ('extra = ["6078"]', "rated_current_a is missing: expected the rated value that 6078:0 multiplies"),
        ('extra = ["2081:1"]', "extra[0] = '2081:1': its type is not known"),
        ('extra = ["606C"]\ntpdo = [{ objects = ["6041", "6064", "6074"] }]', "no PDO from the drive carries 606C:0"),
        ('extra = [{ object = "606C", scale = 0.0 }]', "extra[0].scale = 0.0: expected a number other than 0"),
        ('extra = [{ object = "606C", unit = "rpm" }]', "extra[0].unit = 'rpm': expected a scale with it"),
    ],
)
def test_what_is_refused(drive, expected):
    with pytest.raises(AcquisitionError) as caught:
        bus_of(robot_of(bus_text(1, drive=drive)))
    assert expected in str(caught.value)


def recorded(path: Path, robot: Robot, frames: np.ndarray):
    recorder = Recorder(path, robot, source="a test", place="robot.toml")
    recorder.add(frames)
    return recorder.finish(2_000_000_000)


def test_extras_are_recorded_exported_and_summed_up(tmp_path):
    assert recorded(tmp_path / "a.mcap", robot_with_extras(), frames_with_extras()).samples == 20
    recording = read_recording(tmp_path / "a.mcap")
    assert export_csv(tmp_path / "a.mcap", tmp_path / "a.csv") == 20
    header = (tmp_path / "a.csv").read_text().splitlines()[0].split(",")
    assert header[-4:] == ["motor_1_velocity_rad/s", "motor_1_torque_N_m", "motor_1_temperature_degC", "motor_1_2082:0"]
    table = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    assert table[:, -4:].tolist() == recording.samples["extra"].tolist()
    ranges = overview(recording)["extras"]
    assert [(e["name"], e["value"]) for e in ranges[2:]] == [
        ("temperature", (pytest.approx(25.3),) * 2),
        ("2082:0", (7.0, 7.0)),
    ]


def test_simulated_drives_tell_their_velocity(tmp_path):
    robot = robot_of(bus_text(2, drive='extra = ["606C"]'))
    run = dry_session(tmp_path / "a.mcap", Task(reference=swing(2, seconds=0.6, amplitude=0.05)), robot=robot)
    samples = run.recording.samples
    motor = 50 * np.gradient(samples["position"], 0.002, axis=0)
    assert np.ptp(motor) > 10
    assert np.abs(samples["extra"] - motor)[5:-5].max() < 0.03 * np.ptp(motor)


def test_a_wrong_period_loses_no_frame_and_the_corrected_description_decodes_it(tmp_path):
    robot, frames = robot_of(bus_text(2)), flat(session(period_ns=5_400_000))
    done = recorded(tmp_path / "a.mcap", robot, frames)
    assert (done.samples, done.frames) == (0, len(frames))
    assert "SYNC came every 5.4 ms; bus.sync_period_s = 0.002 in robot.toml: expected 0.0054;" in done.no_samples
    recording = read_recording(tmp_path / "a.mcap")
    assert recording.samples is None
    (kept,) = recording.frames.values()
    assert kept.tobytes() == frames.tobytes()
    with pytest.raises(AcquisitionError, match="SYNC came every"):
        import_recording(tmp_path / "a.mcap", tmp_path / "b.mcap", None, "robot.toml")
    assert not (tmp_path / "b.mcap").exists()
    corrected = robot_of(bus_text(2, period_s=0.0054))
    assert import_recording(tmp_path / "a.mcap", tmp_path / "b.mcap", corrected, "robot.toml").samples == 50


def test_a_clock_that_is_set_is_told_apart_from_one_that_goes_on():
    wall, monotonic = [1_000_000_000], [5_000_000_000]
    clock = WallClock(lambda: wall[0], lambda: monotonic[0])
    found = []
    for elapsed_ns, by_ns in (
        (500_000_000, 0),
        (500_000_000, 10_000_000),
        (100, 3_600_000_000_000),
        (100, -50_000_000),
    ):
        wall[0] += elapsed_ns + by_ns
        monotonic[0] += elapsed_ns
        found.append(clock.step_ns())
    assert found == [0, 0, 3_600_000_000_000, -50_000_000]
    assert clock.now_ns() == 2_000_000_200  # as if it had never been set
    assert describe_step(found[2]) == "the clock was set forward by 3.6e+03 s"
    assert describe_step(found[3]) == "the clock was set back by 0.05 s"
