"""The ramp of a quick stop: read before motion, shown by check, refused where it is too slow, and let finish."""

from dataclasses import dataclass

import numpy as np
import pytest
from dry_sessions import DrySession, FaultyDrives, Through, at_boot, dry_session, findings
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.protocol import State, quick_stop_ramp
from acquisition.session import Stop, Task
from acquisition.simulated import LockStepLink, SimulatedDrives

LIMIT = 2.0  # rad/s² of each joint
TEXT = bus_text(2).replace("acceleration_deg_s2 = 4000", f"acceleration_deg_s2 = {np.degrees(LIMIT)}")
ROBOT = robot_of(TEXT.replace("[-150, 150]", "[-260, 260]"))  # wide enough for a path from the middle on
COUNTS = 50 * 65536 / (2 * np.pi)  # of a motor per rad of its joint
SPEED = 2.15  # rad/s at which the stop begins


def path() -> np.ndarray:
    """Both joints up to 2.2 rad/s and down again, within their limits."""
    t = np.arange(0, 4.0, 0.002)
    speed = np.interp(t, [0, 1.2, 2.0, 3.2], [0, 2.2, 2.2, 0])
    return np.repeat(np.cumsum(speed)[:, None] * 0.002, 2, axis=1)


def stopped(file, objects: dict[int, int]) -> tuple[DrySession, list[tuple[float, State, float]]]:
    """A quick stop in full motion, of drives with these objects: time, state of a drive and speed of its joint since."""
    stop, seen = Stop(), []

    class Set(FaultyDrives):
        def __init__(self, *arguments, **named):
            super().__init__(*arguments, **named)
            for node in self.nodes:
                node.values |= {(index, 0): value for index, value in objects.items()}
                node.initial = dict(node.values)
            Watching.drives = self

    @dataclass(kw_only=True)
    class Watching(Through):
        def receive(self, until_ns):
            frame, speed = super().receive(until_ns), self.drives.plant.state()[1]
            stop.at_once |= bool(speed.min() > SPEED)
            stop.reason = "stopped by SIGINT" if stop.at_once else ""
            if stop.at_once:
                seen.append((self.now_ns() * 1e-9, self.drives.states[0], float(speed[0])))
            return frame

    session = dry_session(file, Task(reference=path()), robot=ROBOT, through=Watching, stop=stop, simulated=Set)
    return session, seen


def test_a_quick_stop_takes_its_own_time_and_is_not_cut_at_speed(tmp_path):
    """By 2 rad/s² (605Ah = 5: 6084h)."""
    session, seen = stopped(tmp_path / "a.mcap", {0x605A: 5, 0x6084: round(2 * COUNTS), 0x6085: 1})
    assert session.outcome.reason == "stopped by SIGINT, then again: quick stop"
    assert not session.outcome.unconfirmed
    active = [t for t, state, _ in seen if state is State.QUICK_STOP_ACTIVE]
    off_s, _, speed = next(item for item in seen if item[0] > active[-1] and item[1] is State.SWITCH_ON_DISABLED)
    assert abs(speed) < 0.1 * SPEED
    assert 0.9 * SPEED / 2.0 < off_s - active[0] < SPEED / 2.0 + 0.1


def test_a_quick_stop_below_half_the_acceleration_limit_is_refused(tmp_path):
    objects = {0x605A: 2, 0x6085: round(0.98 * COUNTS)}
    session, _ = stopped(tmp_path / "a.mcap", objects)
    error = session.outcome.error
    assert error.place == "node 1 (motor_1)"
    assert error.expected == "57.3 at least for --track, half the acceleration limit"
    assert not any(np.isin(session.frames["can_id"], [0x201, 0x202]))
    for share, ok in ((0.98, False), (1.0, True)):
        drives = SimulatedDrives(ROBOT, bus_of(ROBOT))
        for node in drives.nodes:
            node.values[0x6085, 0] = node.initial[0x6085, 0] = round(share * COUNTS)
        run = LockStepLink(drives)
        (found,) = findings(run, bus_of(ROBOT), "quick stop", 2)
        assert found.ok == ok
        words = f"{np.degrees(share):.4g} deg/s², {np.radians(200) / share:.3g} s from the speed limit to rest"
        assert found.found.startswith(f"quick stop ramp {words}")


def test_an_unknown_ramp_is_noted(tmp_path, monkeypatch):
    at_boot(monkeypatch, lambda node: node.values.update({(0x605A, 0): 7}))
    session = dry_session(tmp_path / "a.mcap", Task(reference=np.zeros((2, 2))))
    notes = [note.partition(": voltage")[0] for note in session.events("mark")]
    assert notes == [f"node {k} (motor_{k}): quick stop ramp unknown" for k in (1, 2)]


@pytest.mark.parametrize(
    ("values", "ramp"),
    [
        ({0x605A: 1, 0x6084: 7, 0x6085: 9}, 7),
        ({0x605A: 2, 0x6084: 7, 0x6085: 9}, 9),
        ({0x605A: 5, 0x6084: 7, 0x6085: 9}, 7),
        ({0x605A: 6, 0x6084: 7, 0x6085: 9}, 9),
        *(({0x605A: k, 0x6084: 7, 0x6085: 9}, None) for k in (0, 3, 4, 7, 8, None)),
        ({0x605A: 2, 0x6084: 7, 0x6085: None}, None),
        ({0x605A: 2, 0x6085: 0}, None),
        ({}, None),
        # rpm/s as maxon (60AAh) and Nanotec (60A9h: rpm) code it; 60 rpm/s are a turn per s².
        ({0x605A: 6, 0x6085: 60, 0x60AA: 0x00C00300, 0x60A9: 0xFDB44700}, 65536),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0x00B44700}, 65536),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0}, 60),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0x00B44800}, None),  # of another unit
    ],
)
def test_the_ramp_that_605a_names(values, ramp):
    found = quick_stop_ramp(values, bus_of(ROBOT).drives[0].position_codec)
    assert found == (None if ramp is None else pytest.approx(ramp))
