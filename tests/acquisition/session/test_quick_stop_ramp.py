"""The ramp of a quick stop: read before motion, shown by check, refused where it is
too slow, and let finish.
"""

import numpy as np
import pytest
from dry_sessions import Through, at_boot, connected, dry_session, findings
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.protocol import State, quick_stop_ramp
from acquisition.session import Stop, Task

LIMIT = 2.0  # rad/s² of each joint
TEXT = bus_text(2).replace(
    "acceleration_deg_s2 = 4000", f"acceleration_deg_s2 = {np.degrees(LIMIT)}"
)
# wide enough for a path from the middle on
ROBOT = robot_of(TEXT.replace("[-150, 150]", "[-260, 260]"))
COUNTS = 50 * 65536 / (2 * np.pi)  # of a motor per rad of its joint
SPEED = 2.15  # rad/s at which the stop begins
REST = Task(reference=np.zeros((2, 2)))


def with_objects(patch: pytest.MonkeyPatch, objects: dict[int, int]) -> None:
    at_boot(
        patch,
        lambda node: node.values.update({(index, 0): value for index, value in objects.items()}),
    )


def test_quick_stop_takes_its_full_time(tmp_path, monkeypatch):
    """Both joints go up to 2.2 rad/s; they stop by 2 rad/s² (605Ah = 5: 6084h)."""
    # time, state of a drive, speed of its joint since the stop
    stop, seen = Stop(), list[tuple[float, State, float]]()

    class Watching(Through):
        def receive(self, until_ns):
            frame, drives = super().receive(until_ns), self.link.drives
            stop.at_once |= bool(drives.plant.state()[1].min() > SPEED)
            if stop.at_once:
                stop.reason = "stopped by SIGINT"
                seen.append(
                    (self.now_ns() * 1e-9, drives.states[0], float(drives.plant.state()[1][0]))
                )
            return frame

    with_objects(monkeypatch, {0x605A: 5, 0x6084: round(2 * COUNTS), 0x6085: 1})
    speed = np.interp(np.arange(0, 4.0, 0.002), [0, 1.2, 2.0, 3.2], [0, 2.2, 2.2, 0])
    task = Task(reference=np.repeat(np.cumsum(speed)[:, None] * 0.002, 2, axis=1))
    session = dry_session(tmp_path / "a.mcap", task, robot=ROBOT, through=Watching, stop=stop)
    assert session.outcome.reason == "stopped by SIGINT, and again: quick stop"
    assert not session.outcome.unconfirmed
    active = [t for t, state, _ in seen if state is State.QUICK_STOP_ACTIVE]
    off_s, _, speed = next(
        item for item in seen if item[0] > active[-1] and item[1] is State.SWITCH_ON_DISABLED
    )
    assert abs(speed) < 0.1 * SPEED
    assert 0.9 * SPEED / 2.0 < off_s - active[0] < SPEED / 2.0 + 0.1


def test_weak_quick_stop_is_refused(tmp_path, monkeypatch):
    for share, ok in ((1.0, True), (0.98, False)):
        with_objects(monkeypatch, {0x605A: 2, 0x6085: round(share * COUNTS)})
        run, master = connected(ROBOT)
        (found,) = findings(run, master.bus, "quick stop deceleration", 2)
        assert found.ok == ok
        words = (
            f"{np.degrees(share):.4g} deg/s², {np.radians(200) / share:.3g} s from the speed "
            "limit to rest"
        )
        assert found.found.startswith(words)
    session = dry_session(tmp_path / "a.mcap", REST, robot=ROBOT)
    expected = f"{words}: expected at least 57.3 for motion, half the acceleration limit"
    assert (
        f"node 1 (motor_1): quick stop deceleration: {expected}; node 2" in session.outcome.reason
    )
    assert set(session.sent["data"][:, 0].tolist()) == {0x40}  # nothing was written
    assert not any(np.isin(session.frames["can_id"], [0x201, 0x202]))


def test_unknown_deceleration_is_noted(tmp_path, monkeypatch):
    with_objects(monkeypatch, {0x605A: 7})
    notes = [
        note.partition(": voltage")[0]
        for note in dry_session(tmp_path / "a.mcap", REST).events("mark")
    ]
    assert notes == [f"node {k} (motor_{k}): quick stop deceleration: unknown" for k in (1, 2)]


@pytest.mark.parametrize(
    ("values", "ramp"),
    [
        *(
            ({0x605A: k, 0x6084: 7, 0x6085: 9}, ramp)
            for k, ramp in ((1, 7), (2, 9), (5, 7), (6, 9))
        ),
        *(({0x605A: k, 0x6084: 7, 0x6085: 9}, None) for k in (0, 3, 4, 7, 8, None)),
        ({0x605A: 2, 0x6084: 7, 0x6085: None}, None),
        ({0x605A: 2, 0x6085: 0}, None),
        # rpm/s as maxon (60AAh) and Nanotec (60A9h: rpm) code it; 60 rpm/s are a turn per s².
        ({0x605A: 6, 0x6085: 60, 0x60AA: 0x00C00300, 0x60A9: 0xFDB44700}, 65536),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0x00B44700}, 65536),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0}, 60),
        ({0x605A: 2, 0x6085: 60, 0x60A9: 0x00B44800}, None),  # of another unit
    ],
)
def test_quick_stop_deceleration_by_605a(values, ramp):
    found = quick_stop_ramp(values, bus_of(ROBOT).drives[0].position_codec)
    assert found == (None if ramp is None else pytest.approx(ramp))
