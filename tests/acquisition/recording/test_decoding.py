"""Frames → samples: association with SYNC under every fault, counts, times, the
traffic of a third party.
"""

import numpy as np
import pytest
from conftest import needs_data
from made_up_buses import block, bus_of, bus_text, counts, flat, frame, robot_of, session

from acquisition.errors import BadInputError
from acquisition.recording import (
    ERROR,
    EXTENDED,
    REMOTE_REQUEST,
    Decoded,
    decode,
    gaps,
    resolve_mapped,
)

ROBOT = robot_of(bus_text())
BUS = bus_of(ROBOT)


def decoded(intervals) -> Decoded:
    return decode(flat(intervals), ROBOT, BUS, "log")


def positions(
    found: Decoded, codec=BUS.drives[0].position_codec, ratio: float = 50.0
) -> np.ndarray:
    return np.rint(found.samples["position"] * ratio / codec.si(np.array(1))).astype(int)


def right(found: Decoded, *, first: int = 0, lost: tuple[int, ...] = (), syncs: int = 50) -> None:
    k = np.array([k for k in range(first, syncs) if k not in lost])
    assert positions(found)[:, 0].tolist() == [counts(1, i) for i in k]
    assert positions(found)[:, 1].tolist() == [counts(2, i) for i in k]
    assert found.samples["stamp_ns"].tolist() == (1_000_000_000 + k * 2_000_000).tolist()


def test_clean_session():
    found = decoded(session())
    right(found)
    assert found.warnings == ()
    assert found.syncs == 50
    assert [dict(+pdo) for pdo in found.pdos.values()] == [{"received": 50}] * 2
    assert np.mean(np.diff(found.stamps)) == pytest.approx(2e6)
    codec = BUS.drives[0].position_codec
    assert found.samples["position"][3, 0] == pytest.approx(codec.si(np.array(counts(1, 3))) / 50)
    assert found.samples["effort"][3, 1] == pytest.approx((20 + 3) * 0.42e-3 * 50)


def test_missing_duplicate_and_short_pdos():
    intervals = session()
    del intervals[10][1]
    intervals[20].append(intervals[20][2])
    t, can_id, _, flags, data = intervals[30][1]
    intervals[30][1] = (t, can_id, 7, flags, data)
    found = decoded(intervals)
    right(found, lost=(10, 30))
    assert [dict(+pdo) for pdo in found.pdos.values()] == [
        {"received": 48, "missing": 2, "short": 1},
        {"received": 51, "duplicate": 1},
    ]
    assert found.warnings[0] == "2 samples are missing in 2 gaps"
    # A SYNC without a sample is counted, also beside one that was not recorded, but has its sample.
    assert (found.counters["uncertain"], found.syncs_lost) == (2, 0)
    del intervals[40][0]
    found = decoded(intervals)
    right(found, lost=(10, 30))
    assert (found.counters["uncertain"], found.syncs_lost) == (2, 1)
    assert "1 SYNC were answered but not recorded: their times are interpolated" in found.warnings


def test_other_frames_are_ignored():
    noise = []
    for t in range(1_000_000_000, 1_100_000_000, 2_000_000):
        noise += [
            frame(t + 1, 0x181, b"12345678", flag) for flag in (EXTENDED, ERROR, REMOTE_REQUEST)
        ]
        noise += [
            frame(t + 2, 0x701, b"\5"),
            frame(t + 3, 0x581, bytes(8)),
            frame(t + 4, 0x80, b"", EXTENDED),
        ]
    both = np.concatenate([flat(session()), block(noise)])
    found = decode(both[np.argsort(both["time_ns"], kind="stable")], ROBOT, BUS, "log")
    right(found)
    assert found.warnings == ()


@pytest.mark.parametrize("way", [1, -1])
def test_wrong_period_is_refused(way):
    """By more than 5 %, and warned of by more than 1 %."""
    warned = decoded(session(period_ns=2_000_000 + way * 98_000))
    assert warned.warnings[0].endswith("ms, not every 2 ms as in robot.toml: correct sync_period_s")
    with pytest.raises(BadInputError) as caught:
        decoded(session(period_ns=2_000_000 + way * 102_000))
    assert str(caught.value).startswith(
        f"log: SYNC came every {2 + way * 0.102:.4g} ms, but bus.sync_period_s is 0.002 in "
    )
    assert caught.value.advice.startswith(f"Set it to {2e-3 + way * 102e-6:.3g} and import")


def test_sync_pause_keeps_period():
    frames = flat(session())
    frames["time_ns"][75:] += 100_000_000
    found = decode(frames, ROBOT, BUS, "log")
    assert np.median(np.diff(found.stamps)) == pytest.approx(2e6, rel=1e-9)
    assert found.jitter_s == pytest.approx((0, 0), abs=1e-9)
    (gap,) = gaps(found.samples, 500.0)
    assert (gap.row, gap.missing) == (24, 50)
    assert found.warnings == (
        "SYNC paused 1 times for more than 1.5 periods, the longest for 102 ms at 0.048 s: samples "
        "are missing there",
    )


@pytest.mark.parametrize("at_once", [7, 1000])
@pytest.mark.parametrize("way", [1, -1])
def test_wrapping_counter_continues(way, at_once, monkeypatch):
    """Drive 1 comes to the end of 32 bits at SYNC 20, and its targets one SYNC
    earlier; back again at 40.
    """
    values = [way * (2**31 + 10 - abs(30 - k)) for k in range(51)]
    monkeypatch.setattr("acquisition.recording.decoding._AT_ONCE", at_once)
    frames = flat(session(targets=True))
    for can_id, theirs in ((0x181, values[:-1]), (0x201, values[1:])):
        words = (np.array(theirs) % 2**32).astype("<u4").view(np.uint8).reshape(-1, 4)
        frames["data"][frames["can_id"] == can_id, 2:6] = words
    found = decode(frames, ROBOT, BUS, "log")
    expected = BUS.drives[0].position_codec.si(np.array(values[:-1])) / 50
    assert found.samples["position"][:, 0] == pytest.approx(expected, rel=1e-12)
    assert found.samples["reference"][:, 0] == pytest.approx(expected, rel=1e-12)
    first_s = 0.04 if way == 1 else 0.042  # -2^31 is still held
    told = (
        f"motor_1: the position counter wrapped 2 times, first at {first_s:g} s: positions "
        "continue across it"
    )
    assert found.warnings == (told,)


@pytest.mark.parametrize(
    ("intervals", "expected"),
    [
        ([], "log: only 0 of 0 frames are SYNC"),
        (session(1), "no frame 0x182 of 8 bytes"),
        (session(2, 1), "log: only 1 of 3 frames are SYNC"),
    ],
)
def test_undecodable_frames(intervals, expected):
    with pytest.raises(BadInputError, match=expected):
        decoded(intervals)


def test_third_party_traffic_is_decoded_exactly():
    """Mapping out of the master's SDO writes; three PDOs came after the next
    SYNC; the motion is known.
    """
    rows = []
    for line in needs_data("can_logs", "third_party_2drives.log").read_text().splitlines():
        time, _, text = line.split()
        can_id, _, data = text.partition("#")
        rows.append(
            frame(int(time[1:-1].replace(".", "")) * 1000, int(can_id, 16), bytes.fromhex(data))
        )
    frames = block(rows)
    text = bus_text(2, period_s=0.01, ratio=1.0, drive='mapping = "traffic"').replace(
        "65536", "6553600"
    )
    robot = robot_of(text.replace("node = 1\n", "node = 5\n").replace("node = 2\n", "node = 6\n"))
    frames, bus = resolve_mapped(frames, robot, "robot.toml")
    assert bus.warnings == ()
    found, k = decode(frames, robot, bus, "log"), np.arange(1, 300)
    for i, (node, drive) in enumerate(zip((5, 6), bus.drives, strict=True)):
        w = 2 * np.pi * (0.2 + 0.05 * node)
        q, v, a = (
            0.5 * np.sin(w * k * 1e-3),
            0.5 * w * np.cos(w * k * 1e-3),
            -0.5 * w * w * np.sin(w * k * 1e-3),
        )
        counts = positions(found, drive.position_codec, 1.0)[:, i]
        assert counts.tolist() == np.rint(q * 6553600 / (2 * np.pi)).tolist()
        torque = 60 * a + 80 * v + 25 * np.sign(v) + 200 * np.cos(q)
        assert np.abs(found.samples["effort"][:, i] / 0.42e-3 - torque).max() <= 0.5 + 1e-6
    assert [dict(+pdo) for pdo in found.pdos.values()] == [
        {"received": 299, "late": 1},
        {"received": 299, "late": 2},
    ]
