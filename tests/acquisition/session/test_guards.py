"""Each guard provoked in motion on both sides of its limit, and every fault in every phase."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from dry_sessions import Fault, FaultyDrives, Moved, Through, dry_session, say, swing
from made_up_buses import bus_text, robot_of

import acquisition.session.running as record_module
import acquisition.session.session as session_module
from acquisition.commands import main
from acquisition.protocol import State, status_words
from acquisition.session import Outcome, Stop, Task

REST = Task(reference=np.zeros((151, 2)))  # 0.3 s
LIMIT = np.radians(200)  # rad/s
BEGIN_S = 0.45  # after the brakes opened: in the track phase


class Scripted(Moved):
    """Joint 2 goes where it likes once the brakes are open, whatever its drive does:
    `where(t)` rad after BEGIN_S.
    """

    def __init__(self, where: Callable[[float], float]) -> None:
        self.where, self.t = where, -BEGIN_S

    def step(self, effort, held, duration_s):
        self.t += 0.0 if held.any() else duration_s
        self.q = np.array([0.0, self.where(self.t) if self.t > 0 else 0.0])


def there_and_back(height: float, speed: float) -> Callable[[float], float]:
    top_s = abs(height / speed)
    return lambda t: height * (1 - abs(t - top_s) / top_s) if t < 2 * top_s else 0.0


def with_limits(position: str = "[-150, 150]", following: float = 90.0) -> str:
    text = bus_text(2).replace("position_deg = [-150, 150]", f"position_deg = {position}")
    return text.replace("following_error_deg = 5", f"following_error_deg = {following}")


FAST, LOW, HIGH, OFF = 1.2 * LIMIT, np.radians(-10), np.radians(20), np.radians(1.0)


def one_after_the_other(first, then, at_s: float) -> Callable[[float], float]:
    return lambda t: first(t) if t < at_s else then(t - at_s)


@pytest.mark.parametrize(
    ("limits", "inside", "key", "expected", "beyond"),
    [
        # Speed in both directions, both ends of the range, following errors of both signs; with
        # bounds of the value told.
        ({}, there_and_back(0.1, 0.99 * FAST), "speed", "at most 3.491",
         [(lambda t: min(t * 1.01 * FAST, 0.1), 4.2305, 4.2315),
          (lambda t: max(-t * 1.01 * FAST, -0.1), 4.2305, 4.2315)]),
        ({"position": "[-10, 20]"},
         one_after_the_other(there_and_back(0.999 * HIGH, 3.0), there_and_back(0.999 * LOW, 3.0),
                             0.24),
         "position", "-0.1745 to 0.3491",
         [(there_and_back(1.05 * LOW, 3.0), 1.05 * LOW, LOW),
          (there_and_back(1.05 * HIGH, 3.0), HIGH, 1.05 * HIGH)]),
        ({"following": 1.0},
         one_after_the_other(there_and_back(0.99 * OFF, 1.0), there_and_back(-0.99 * OFF, 1.0),
                             0.04),
         "following error", "at most 0.01745",
         [(there_and_back(1.15 * OFF, 1.0), OFF, 0.02),
          (there_and_back(-1.15 * OFF, 1.0), OFF, 0.02)]),
    ],
)  # fmt: skip
def test_joint_beyond_limit_stops(tmp_path, limits, inside, key, expected, beyond):
    robot = robot_of(with_limits(**limits))
    session = dry_session(tmp_path / "inside.mcap", REST, robot=robot, plant=Scripted(inside))
    assert session.outcome.reason == "finished"
    for k, (where, low, high) in enumerate(beyond):
        session = dry_session(tmp_path / f"{k}.mcap", REST, robot=robot, plant=Scripted(where))
        error = session.outcome.error
        assert (error.place, error.key, error.expected) == ("joint_2", key, expected)
        assert low < error.value < high
        assert not session.outcome.unconfirmed


class Obedient(Moved):
    """Joints that are at each SYNC where their drives were sent before the SYNC before."""

    drives: FaultyDrives

    def step(self, effort, held, duration_s):
        if not held.any():
            self.q = np.array(
                [n.values[0x607A, 0] * 2 * np.pi / (50 * 65536) for n in self.drives.nodes]
            )


def test_following_error_is_of_previous_target(tmp_path):
    plant = Obedient()

    class Here(FaultyDrives):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            plant.drives = self

    # 0.216° from SYNC to SYNC, in which a drive that follows at once has no error.
    task = Task(reference=swing(2, seconds=1.0, amplitude=0.3))
    robot = robot_of(with_limits(following=0.15))
    session = dry_session(tmp_path / "a.mcap", task, robot=robot, plant=plant, simulated=Here)
    assert session.outcome.reason == "finished"


def test_approach_beyond_limits_is_refused(tmp_path, monkeypatch):
    there = np.linspace([0.0, 0.0], [3.0, 0.0], 2000)  # 172° of 150
    monkeypatch.setattr(session_module, "approach", lambda *_: there)
    session = dry_session(tmp_path / "a.mcap", REST)
    assert session.outcome.error.place.startswith("the approach to the reference's start")
    assert session.events("phase")[-1] == "enable"
    # the sag when the brakes open
    assert np.abs(session.recording.samples["position"]).max() < 0.01


def test_never_set_status_bit_is_ignored(tmp_path):
    never = Fault(kind="clear", node=2, sync=1, count=10_000, bits=0x1200)
    assert dry_session(tmp_path / "a.mcap", REST, faults=[never]).outcome.reason == "finished"


def test_drive_warning_is_recorded_once(tmp_path, monkeypatch):
    say(monkeypatch, lambda node, word: word | (node == 2) << 11)
    session = dry_session(tmp_path / "a.mcap", REST)
    assert session.outcome.reason == "finished"
    assert session.events("mark") == ["node 2 (motor_2): internal limit active"]


def test_statusword_bits_in_words():
    words = {
        0x0237 | 1 << 7: "operation enabled, warning",
        0x0237 | 1 << 13: "operation enabled, following error",
        0x0037: "operation enabled, not remote: the controlword is ignored",
        0x0227: "operation enabled, no voltage on the power stage",
        0x0218: "fault",
        0x0216: "statusword 0x0216, which is not a CiA 402 state",
    }
    assert {word: status_words(word) for word in words} == words


@dataclass(kw_only=True)
class Counting(Through):
    """Counts the SYNCs that the session sends; after `at_sync` of them it does not run for
    `for_s` of simulated time.
    """

    syncs: int = 0
    at_sync: int = 0
    for_s: float = 0.0

    def send(self, can_id, data):
        self.syncs += can_id == 0x80
        super().send(can_id, data)

    def receive(self, until_ns):
        frame = super().receive(until_ns)
        if self.at_sync == self.syncs > 0 and frame is None:  # the next SYNC is due now
            self.at_sync, self.link._time_ns = 0, until_ns + round(self.for_s * 1e9)
        return frame


@pytest.mark.parametrize(("for_s", "fault"), [(0.018, False), (2.0, True)])
def test_late_sync_in_motion(tmp_path, for_s, fault):
    session = dry_session(
        tmp_path / "a.mcap", REST, through=partial(Counting, at_sync=170, for_s=for_s)
    )
    assert session.outcome.fault is fault
    assert not session.outcome.unconfirmed
    frames = session.frames
    steps_s = np.diff(frames["time_ns"][frames["can_id"] == 0x80]) * 1e-9
    assert for_s - 0.003 < steps_s.max() < for_s + 0.006  # the gap stands in the recording
    assert steps_s.min() >= 0.001  # and no burst of SYNCs makes up for it
    if fault:
        assert session.outcome.reason.startswith("SYNC was 2 s late in motion, more than 0.02 s")


def test_second_ctrl_c_is_quick_stop(tmp_path):
    stop = Stop()

    @dataclass(kw_only=True)
    class Impatient(Counting):
        def receive(self, until_ns):
            if self.syncs > 170:
                stop.reason = "stopped by SIGINT"
            if self.syncs > 190:
                stop.at_once = True
            return super().receive(until_ns)

    session = dry_session(
        tmp_path / "a.mcap", Task(reference=np.zeros((1001, 2))), through=Impatient, stop=stop
    )
    assert session.outcome.fault
    assert session.outcome.reason == "stopped by SIGINT, and again: quick stop"
    assert not session.outcome.unconfirmed


PHASES = ("enable", "approach", "track", "stop", "disable")
SHORT = Task(reference=np.zeros((51, 2)))  # 0.1 s
REASONS = {**dict.fromkeys(("silent", "deaf"), "the drive has not answered 3 SYNCs in a row"),
           "reset": "the drive has restarted",
           "emergency": "the drive reports emergency 0x2310 (continuous over current)"}  # fmt: skip


@pytest.fixture(scope="module")
def sync_of(tmp_path_factory) -> dict[str, int]:
    """A SYNC early in each phase, counted from 1."""
    session = dry_session(tmp_path_factory.mktemp("phases") / "a.mcap", SHORT)
    frames = session.frames
    syncs = frames["time_ns"][frames["can_id"] == 0x80]
    return {phase: int(np.sum(syncs < session.phases[phase])) + 2 for phase in PHASES}


@pytest.mark.parametrize(
    ("kind", "phase"),
    [*itertools.product(("silent", "emergency"), PHASES), ("reset", "approach"),
     ("reset", "track"), ("deaf", "enable"),
     ("deaf", "stop")],
)  # fmt: skip
def test_every_fault_in_every_phase_ends_disabled(tmp_path, sync_of, phase, kind):
    fault = Fault(kind=kind, node=1, sync=sync_of[phase], count=10_000 if kind == "deaf" else 1)
    session = dry_session(tmp_path / "a.mcap", SHORT, faults=[fault])
    assert session.events("phase")[-1] == phase
    outcome = session.outcome
    assert outcome.fault
    assert outcome.reason.startswith(f"node 1 (motor_1): {REASONS[kind]}")
    assert session.events("fault") == [outcome.reason]
    assert outcome.unconfirmed == ((1,) if kind == "silent" else ())
    assert [isinstance(item, Outcome) for item in session.announced] == [True]
    assert session.announced[0].alarm == (
        "NOT DISABLED: nodes 1: EMERGENCY STOP" if kind == "silent" else ""
    )
    assert session.events("not disabled" if kind == "silent" else "disabled")
    if kind == "emergency":
        report = (
            "node 1 (motor_1): error register 1001 = 0x01, last error 1003:1 = 0x2310 "
            "(continuous over current)"
        )
        assert outcome.reports[0].startswith(report)
        assert session.events("mark") == list(outcome.reports)
    assert session.drives.states[1] is not State.OPERATION_ENABLED


@pytest.mark.parametrize("kind", ["silent", "emergency"])
def test_terminal_names_enabled_drives_first(tmp_path, monkeypatch, capsys, kind):
    faults = [Fault(kind=kind, node=1, sync=130)]
    monkeypatch.setattr(record_module, "SimulatedDrives", partial(FaultyDrives, faults=faults))
    robot, table = tmp_path / "robot.toml", tmp_path / "ref.csv"
    robot.write_text(bus_text(2))
    table.write_text("time_s,joint_1,joint_2\n0,0,0\n0.3,0,0\n")
    status = main(
        ["record", str(robot), "-o", str(tmp_path / "a.mcap"), "--track", str(table), "--dry-run"]
    )
    lines = capsys.readouterr().err.splitlines()
    assert status == 1
    if kind == "silent":
        assert lines.pop(0) == "NOT DISABLED: nodes 1: EMERGENCY STOP"
    (line,) = lines
    assert line.startswith(
        f"robot-acquire: {tmp_path / 'a.mcap'}: the session ended with a fault: "
        f"node 1 (motor_1): {REASONS[kind]}"
    )
    if kind == "emergency":
        assert "; node 1 (motor_1): error register 1001 = 0x01, last error 1003:1 = 0x2310" in line
