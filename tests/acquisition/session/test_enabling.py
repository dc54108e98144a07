"""While drives are enabled: held arms do not sink, joints that run away are caught, and nothing
jumps when motion begins.
"""

import numpy as np
import pytest
from dry_sessions import DrySession, Fault, FaultyDrives, at_boot, dry_session, swing
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.protocol import State
from acquisition.session import Task
from acquisition.simulated import JointwisePlant, rated_motor_effort, typical_plant

DEG = np.degrees(1.0)
TRACK = Task(reference=swing(2, seconds=0.4, amplitude=0.02))
NEVER = Fault(kind="slow", node=2, sync=1, count=100_000)


def loaded(share: float) -> JointwisePlant:
    robot = robot_of(bus_text(2))
    return typical_plant(robot, rated_motor_effort(bus_of(robot)), share)


def targets(session: DrySession, node: int) -> np.ndarray:
    ours = session.sent[session.sent["can_id"] == 0x200 + node]
    return ours["data"][:, 2:6].copy().view("<i4")[:, 0]


def phase_of(session: DrySession, name: str) -> np.ndarray:
    stamps, samples = session.phases, session.recording.samples
    then = min(stamp for stamp in stamps.values() if stamp > stamps[name])
    return samples[(samples["stamp_ns"] >= stamps[name]) & (samples["stamp_ns"] < then)]


@pytest.mark.parametrize("late_s", [0.0, 1.2])
def test_arm_under_half_load_is_held(tmp_path, late_s):
    late = [Fault(kind="slow", node=2, sync=1, count=round(late_s / 0.002))] if late_s else []
    session = dry_session(tmp_path / "a.mcap", TRACK, plant=loaded(0.5), faults=late)
    assert session.outcome.reason == "finished"
    enabling = phase_of(session, "enable")
    start = enabling["position"][0]
    stood = (
        phase_of(session, "approach")["position"][:3]
        if late_s
        else phase_of(session, "track")["position"][:3]
    )
    # The first drive has settled: none of its sag is left; the loop, of 5 Hz, needed some
    # while the load came on.
    assert np.abs(stood[:, 0] - start[0]).max() * DEG < (0.001 if late_s else 0.02)
    if late_s:
        assert len(enabling) > 600
        assert 0.01 < np.abs(enabling["position"] - start).max() * DEG < 1.0
    # Held to the count, and no step when motion begins: the reference starts here, so the
    # approach goes nowhere.
    for node in (1, 2):
        assert np.ptp(targets(session, node)[: len(enabling) + 90]) == 0
    assert len(phase_of(session, "approach")) == pytest.approx(100, abs=3)


def test_target_follows_before_enabling(tmp_path):
    """Someone turns a joint by hand (brake open) before its drive is enabled: the target goes
    along, within the limit.
    """

    class Turned(JointwisePlant):
        def step(self, effort, held, duration_s):
            super().step(effort, held, duration_s)
            if held[1]:
                self._q[1] += 0.05 * duration_s  # 0.05 rad/s

    plant = loaded(0.0)
    plant.__class__ = Turned
    late = [Fault(kind="slow", node=2, sync=1, count=100)]
    session = dry_session(tmp_path / "a.mcap", TRACK, plant=plant, faults=late)
    assert session.outcome.reason == "finished"
    enabling = phase_of(session, "enable")["position"][:, 1]
    assert enabling[-1] - enabling[0] == pytest.approx(0.05 * 0.2, rel=0.1)
    # It is held at the last position that came before the drive said it was enabled.
    held = targets(session, 2)[len(enabling) + 1] / (50 * 65536 / (2 * np.pi))
    assert held == pytest.approx(enabling[-2], abs=2e-4)


def test_motion_beyond_enabling_limit_is_fault(tmp_path):
    """The sag under 50 % load until the loop has built up its effort, and
    limits on both sides of it.
    """

    def enabled(name: str, limit_deg: float) -> DrySession:
        robot = robot_of(bus_text(2, extra=f"enable_motion_deg = {limit_deg:.6f}"))
        late = [Fault(kind="slow", node=2, sync=1, count=100)]
        return dry_session(tmp_path / name, TRACK, robot=robot, plant=loaded(0.5), faults=late)

    positions = phase_of(enabled("free.mcap", 1.0), "enable")["position"]
    sag_deg = np.abs(positions - positions[0]).max() * DEG
    assert 0.1 < sag_deg < 1.0
    assert enabled("inside.mcap", 1.02 * sag_deg).outcome.reason == "finished"
    error = enabled("beyond.mcap", 0.98 * sag_deg).outcome.error
    assert (error.place, error.key) == ("joint_1", "motion while drives were enabled")
    assert -0.98 * sag_deg / DEG > error.value > -1.2 * sag_deg / DEG
    assert error.expected == f"at most {0.98 * sag_deg / DEG:.4g}"


class Runaway(JointwisePlant):
    """The effort of joints acts the wrong way round: wrong commutation."""

    ways: np.ndarray
    farthest: float

    def step(self, effort, held, duration_s):
        super().step(effort * self.ways, held, duration_s)
        self.farthest = max(self.farthest, np.abs(self.state()[0]).max())


@pytest.mark.parametrize(
    ("ways", "share", "late"),
    [([-1, -1], 0.1, []), ([-1, -1], 0.3, []), ([-1, -1], 0.5, []), ([-1, 1], 0.3, [NEVER])],
)
def test_runaway_while_enabling_is_stopped(tmp_path, ways, share, late):
    plant = loaded(share)
    plant.__class__, plant.ways, plant.farthest = Runaway, np.array(ways), 0.0
    session = dry_session(tmp_path / "a.mcap", TRACK, plant=plant, faults=late)
    assert session.outcome.error.key == "motion while drives were enabled"
    assert not session.outcome.unconfirmed
    assert 1.0 < plant.farthest * DEG < 3.5
    frames = session.frames
    words = [
        set((frames[frames["can_id"] == 0x180 + k]["data"][:, 0] & 0x0F).tolist()) for k in (1, 2)
    ]
    assert (0x07 in words[0], 0x07 in words[1]) == (True, not late)


@pytest.mark.parametrize(("extra", "watch_s"), [("", 0.2), ("enable_watch_s = 0.1", 0.1)])
def test_last_enabled_drive_is_watched(tmp_path, extra, watch_s):
    robot = robot_of(bus_text(2, extra=extra))
    late = [Fault(kind="slow", node=2, sync=1, count=100)]
    session = dry_session(
        tmp_path / "a.mcap", Task(reference=np.zeros((2, 2))), robot=robot, faults=late
    )
    frames = session.frames
    last = frames[(frames["can_id"] == 0x182) & (frames["data"][:, 0] == 0x37)]["time_ns"][0]
    assert (session.phases["approach"] - last) * 1e-9 == pytest.approx(watch_s, abs=0.005)


def test_drive_lost_while_enabling_is_fault(tmp_path):
    made = []

    class Falling(FaultyDrives):
        def receive(self, now_ns, can_id, data):
            if not made and now_ns > 1_600_000_000:
                assert self.states == [State.OPERATION_ENABLED, State.SWITCHED_ON]
                made.append(self)
                self.nodes[0].state = State.READY_TO_SWITCH_ON
            return super().receive(now_ns, can_id, data)

    late = [Fault(kind="slow", node=2, sync=1, count=200)]
    session = dry_session(tmp_path / "a.mcap", TRACK, faults=late, simulated=Falling)
    assert (
        session.outcome.reason
        == "node 1 (motor_1): the drive has left operation enabled in motion: ready to switch on"
    )
    assert session.events("phase")[-1] == "enable"


def test_fault_is_reset_by_rising_edge(tmp_path, monkeypatch):
    """The controlword that another program has left has bit 7 set already."""

    def in_fault(node):
        node.state = State.FAULT
        node.tick()
        node.values[0x6040, 0] = 0x80

    at_boot(monkeypatch, in_fault)
    session = dry_session(tmp_path / "a.mcap", TRACK)
    assert session.outcome.reason == "finished"
    assert session.events("mark") == [f"node {k}: in fault before the session" for k in (1, 2)]


def test_unconfirmed_fault_is_not_reset(tmp_path, monkeypatch):
    """It comes while the operator is asked, and sends no emergency."""
    nodes = []
    at_boot(monkeypatch, nodes.append)

    def asked(master):
        nodes[-1].state = State.FAULT
        nodes[-1].tick()
        return ()

    session = dry_session(tmp_path / "a.mcap", Task(reference=TRACK.reference, before_motion=asked))
    assert session.outcome.reason.startswith("node 2 (motor_2): the drive went into fault")
    assert session.drives.states[1] is State.FAULT
