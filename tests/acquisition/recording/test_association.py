"""PDOs and SYNCs: sequences of frames made by hand with their answers."""

import struct
from collections.abc import Iterable

import numpy as np
import pytest
from made_up_buses import block, bus_of, bus_text, flat, frame, robot_of, session

from acquisition.errors import BadInputError
from acquisition.recording import SENT, Block, Decoded, decode

ROBOT = robot_of(bus_text())
BUS = bus_of(ROBOT)
PERIOD_NS = 2_000_000


def sequence(text: str) -> Block:
    """Frames out of words: `S` SYNC one period after the one before, `S+2.1` so many periods after
    it, `S#3` with the counter 3, `+` a period goes by, `1:7` node 1 answers with position and
    effort 7, `t1:7` the target 7 of node 1.
    """
    rows, sync_ns, now_ns = [], 1_000_000_000 - PERIOD_NS, 0
    for word in text.split():
        if word[0] == "S":
            name, _, counter = word.partition("#")
            sync_ns += round(float(name[1:] or 1) * PERIOD_NS)
            now_ns = sync_ns
            rows.append(frame(now_ns, 0x80, bytes([int(counter)]) if counter else b""))
            continue
        now_ns += PERIOD_NS if word == "+" else 1000
        if word == "+":
            continue
        node, value = (int(part) for part in word.removeprefix("t").split(":"))
        data = (
            struct.pack("<Hi", 15, value)
            if word[0] == "t"
            else struct.pack("<Hih", 0x1237, value, value)
        )
        rows.append(frame(now_ns, (0x200 if word[0] == "t" else 0x180) + node, data))
    return block(rows)


def decoded(text: str) -> Decoded:
    return decode(sequence(text), ROBOT, BUS, "log")


def told(text: str) -> tuple[list[int], int]:
    """Position counts in each sample, the same of both drives, and the SYNCs found to be lost."""
    found = decoded(text)
    first, second = (
        found.samples["position"] * 50 / BUS.drives[0].position_codec.si(np.array(1))
    ).T
    np.testing.assert_array_equal(first, second)
    return np.rint(first).astype(int).tolist(), found.syncs_lost


BEFORE, AFTER = "S 1:1 2:1 S 1:2 2:2 S 1:3 2:3 S 1:4 2:4", "S 1:7 2:7 S 1:8 2:8 S 1:9 2:9"


@pytest.mark.parametrize(
    ("between", "samples", "lost"),
    [
        # In time; a drive late by one; both late, behind a SYNC that came late by one period.
        ("S 1:5 2:5 S 1:6 2:6", [5, 6], 0),
        ("S 2:5 S 1:5 1:6 2:6", [5, 6], 0),
        ("S S+1 1:5 2:5 1:6 2:6", [5, 6], 0),
        # A SYNC not recorded: two answers of each drive in two periods; one of them late; one
        # missing of one drive.
        ("S 1:5 2:5 1:6 2:6 S+2 1:60 2:60", [5, 6, 60], 1),
        ("S 1:5 2:5 2:6 S+2 1:6 1:60 2:60", [5, 6, 60], 1),
        ("S 1:5 2:5 + 1:6 2:6 + 1:55 2:55 S+3 1:60 2:60", [5, 6, 55, 60], 2),
        # A SYNC not recorded, and answers of both drives late or missing: which ones is not known.
        ("S S+1 1:5 2:5 1:6 2:6 S+2 1:60 2:60", [60], 1),
        ("S 1:5 2:5 S+2 1:6 2:6", [6], 1),
        # A step that is no whole number of periods is a pause.
        ("S 1:5 2:5 S+2.4 1:6 2:6", [5, 6], 0),
        # More answers than SYNCs: which ones count is not known.
        ("S 1:5 2:5 1:6 2:6 1:55 2:55 S+2 1:60 2:60", [60], 1),
        ("S 1:5 2:5 1:55 2:55 S 1:6 2:6", [6], 0),
        # One missing; the same once more is no late one, and something else is.
        ("S 2:5 S 1:6 2:6", [6], 0),
        ("S 2:5 S 1:6 2:6 1:6", [6], 0),
        ("S 2:5 S 1:5 2:6 1:6", [5, 6], 0),
        # 2:6 and 2:60 are missing, 2:5 is late: one interval with a PDO of each
        # drive proves nothing.
        ("S 1:5 S 1:6 2:5 S 1:60 S 1:61 2:61", [61], 0),
        # Another producer's SYNC once more: the two have one set of answers between them.
        ("S S+0.2 1:5 2:5 S+0.8 1:6 2:6", [5, 6], 0),
        ("S 1:5 S+0.2 2:5 S+0.8 1:6 2:6", [5, 6], 0),
        ("S 1:5 2:5 S+0.2 S+0.8 1:6 2:6", [5, 6], 0),
        ("S S+0.2 S+0.2 1:5 2:5 S+0.6 1:6 2:6", [5, 6], 0),
        ("S S+0.1 S+0.1 1:5 2:5 S+0.8 1:6 2:6", [5, 6], 0),
        # One of its own for each: an additional SYNC; SYNCs that were read late, in a burst.
        ("S 1:5 2:5 S+0.2 1:55 2:55 S+0.8 1:6 2:6", [5, 55, 6], 0),
        ("S+1.8 1:5 2:5 S+0.2 1:55 2:55 S 1:6 2:6", [5, 55, 6], 0),
        ("S+2.8 S+0.1 S+0.1 1:5 2:5 1:55 2:55 1:6 2:6", [5, 55, 6], 0),
        # A SYNC that is not recorded, unnoticed, and then late answers: as many as
        # SYNCs, but not to these.
        ("S 1:5 2:5 1:6 2:6 S+2.4 S 1:55 2:55 1:56 2:56 S 1:60 2:60 S 1:61 2:61", [61], 0),
        # Where drives are late, one that is missing may hide that a late one came in its place:
        # 2:6, in the interval of 2:61.
        (
            "S 1:5 S 1:55 2:5 2:55 S 1:6 S 1:61 2:6 S 1:62 2:62 S 1:63 2:63 S 1:64 2:64",
            [62, 63, 64],
            0,
        ),
    ],
)
def test_sequences_with_known_answers(between, samples, lost):
    assert told(f"{BEFORE} {between} {AFTER}") == ([1, 2, 3, 4, *samples, 7, 8, 9], lost)


def late_by_one(first: int, end: int) -> str:
    """Answers of drive 2 in the period after their own."""
    shifted = " ".join(f"S 1:{k} 2:{k - 1}" for k in range(first + 1, end))
    return f"S 1:{first} {shifted} S 1:{end} 2:{end - 1} 2:{end}"


def answered(syncs: Iterable[int]) -> str:
    return " ".join(f"S 1:{k} 2:{k}" for k in syncs)


@pytest.mark.parametrize(
    ("text", "samples", "lost"),
    [
        # A drive is late by one for a while. For long, at its usual time, it rather lost a PDO
        # and sent another twice.
        (f"{BEFORE} {late_by_one(5, 16)} S 1:17 2:17", range(1, 18), 0),
        (f"{BEFORE} {late_by_one(5, 40)} S 1:41 2:41", (1, 2, 3, 4, 41), 0),
        # A first answer that is late belongs to the first SYNC.
        (f"S 2:0 S 1:0 2:1 1:1 {answered(range(2, 9))}", range(9), 0),
        # 2:0 was pending when the recording began, and 2:3 is lost: until then
        # every SYNC has an answer.
        (f"S 1:1 2:0 S 1:2 2:1 2:2 S 1:3 {answered(range(4, 12))}", range(4, 12), 0),
        # 1:2 is lost, 1:9 late.
        (f"{answered(range(2))} S 2:2 {answered(range(3, 9))} S 2:9 S 1:9 1:10 2:10 "
         f"{answered(range(11, 17))}",
         (0, 1, 4, 5, 6, 7, 8, *range(11, 17)), 0),
        # Late by one, then 1:7 and 1:12 are lost: what comes between is in order if there are more
        # such intervals in a row than late drives had: four; five after one with 1:61 and 2:6.
        (f"{answered(range(5))} S 1:5 S 1:6 2:5 2:6 S 2:7 {answered(range(8, 12))} S 2:12 "
         f"{answered(range(13, 21))}",
         (*range(5), *range(9, 12), *range(14, 21)), 0),
        (f"{answered(range(5))} S 1:5 S 1:6 2:5 S 1:61 2:6 2:61 S 2:7 {answered(range(8, 13))} "
         f"S 2:13 {answered(range(14, 22))}",
         (*range(5), *range(10, 13), *range(16, 22)), 0),
        # A counter tells what was lost.
        ("S#8 1:1 2:1 S#9 1:2 2:2 S+1#1 1:4 2:4 1:5 2:5 S#3 1:6 2:6", (1, 2, 4, 5, 6), 1),
    ],
)  # fmt: skip
def test_recordings_with_known_answers(text, samples, lost):
    assert told(text) == ([*samples], lost)


@pytest.mark.parametrize(("early", "first"), [("", (1, 1)), ("t1:7 t2:8", (7, 8))])
def test_target_acts_from_next_sync(early, first):
    between = (
        "t1:10 t2:20 S 1:2 2:2 t1:11 t2:21 S 1:3 2:3 t1:12 t1:13 t2:22 S 1:4 2:4 t1:14 S 1:5 2:5"
    )
    found = decoded(f"{early} S 1:1 2:1 {between}")
    counts = np.array([[first[0], 10, 11, 13, 14], [first[1], 20, 21, 22, 22]])
    joint = BUS.drives[0].position_codec.si(counts) / 50
    np.testing.assert_allclose(found.samples["reference"].T, joint, rtol=1e-12)


def test_no_samples_over_5_percent_missing():
    frames = flat(session(syncs=1440))
    of_first = np.flatnonzero(frames["can_id"] == 0x181)
    kept = {count: np.delete(frames, of_first[100 : 100 + 10 * count : 10]) for count in (70, 80)}
    assert len(decode(kept[70], ROBOT, BUS, "log").samples) == 1440 - 70
    with pytest.raises(
        BadInputError, match=r"log: 5.6% of the PDOs of a drive are missing, more than 5%"
    ):
        decode(kept[80], ROBOT, BUS, "log")
    # Not in the span in which all drives answer: it has begun later.
    assert len(decode(np.delete(frames, of_first[:80]), ROBOT, BUS, "log").samples) == 1440 - 80


@pytest.mark.parametrize("sent", [0, SENT])
def test_pause_with_lost_sync_gives_no_row(sent):
    """One burst: answers of two drives to one SYNC, the next SYNC, and the
    answers of the third to it.
    """
    robot, frames = robot_of(bus_text(3)), flat(session(3, 1000))
    frames["flags"] = sent * (frames["can_id"] == 0x80)
    sync_ns = frames["time_ns"][frames["can_id"] == 0x80]
    found = decode(
        np.delete(frames, np.arange(4 * 700 + 2, 4 * 700 + 6)), robot, bus_of(robot), "log"
    )
    assert np.delete(sync_ns, [700, 701]).tolist() == found.samples["stamp_ns"].tolist()


def test_unrecorded_last_sync_is_one_period_later():
    found = decoded(f"{BEFORE} S 1:5 2:5 + 1:6 2:6")
    assert np.diff(found.samples["stamp_ns"]).tolist() == [PERIOD_NS] * 5
    assert found.syncs_lost == 1


def test_late_answers_differ_from_sync_bursts():
    late = decoded(f"{BEFORE} S 1:5 S 1:6 2:5 2:6 {AFTER}")
    assert [pdo["late"] for pdo in late.pdos.values()] == [0, 1]
    burst = decoded(f"{BEFORE} S+1.8 S+0.2 1:5 2:5 1:6 2:6 {AFTER}")
    assert [pdo["late"] for pdo in burst.pdos.values()] == [0, 0]
    assert len(burst.stamps) == 9


def test_repeat_before_lost_sync_is_not_duplicate():
    """There are two sets of answers, but in two periods."""
    found = decoded(
        f"{answered(range(12))} S S+0.2 1:12 2:12 + 1:13 2:13 S+1.8 1:14 2:14 "
        f"{answered(range(15, 30))}"
    )
    assert np.diff(found.stamps).tolist() == [PERIOD_NS] * 29
    assert found.syncs_lost == 1


def test_sync_sent_twice_counts_twice():
    frames = sequence(f"{answered(range(12))} S S+0.2 1:12 2:12 S+0.8 {answered(range(13, 30))}")
    frames["flags"] = SENT * (frames["can_id"] == 0x80)
    assert decode(frames, ROBOT, BUS, "log").syncs == 32


@pytest.mark.parametrize("again", ["S+0.2", "S+0.1 S+0.1", "S+0.001"])
def test_repeated_sync_keeps_times(again):
    rest = 1 - sum(float(word[1:]) for word in again.split())
    found = decoded(f"{BEFORE} S {again} 1:5 2:5 S+{rest} 1:6 2:6 {AFTER}")
    assert found.syncs == 9
    assert np.diff(found.stamps).tolist() == [PERIOD_NS] * 8
    assert found.warnings == ()
