"""What drives have mapped by the SDO in a log: answers, refusals, losses, starts (CiA 301)."""

import struct

import numpy as np
import pytest
from made_up_buses import block, bus_text, counts, flat, frame, robot_of, session

from acquisition.errors import BadInputError
from acquisition.recording import Decoded, decode, resolve_mapped

ROBOT = robot_of(bus_text(drive='mapping = "traffic"'))
TABLE = robot_of(bus_text())
STATUS, POSITION, DEMAND, ACTUAL = 0x60410010, 0x60640020, 0x60740010, 0x60770010
OK, LOST, UNSEEN, SEVERAL = "ok", "answer lost", "request lost", "in segments"
CANNOT_BE_MAPPED = 0x06040041
SILENT = "the log contains no answers of drives: the mapping is what the master wrote"
LEFT_OUT = "PDOs are left out: when they were sent, a drive had another mapping"


def talk(t_ms: float, node: int, *steps, server: int = 0) -> list:
    """Writes by SDO of (index, sub-index, value, what becomes of it), 1 ms each; a number is the
    code of an abort. `server` answers in place of the node.
    """
    rows = []
    for k, (index, sub, value, end) in enumerate(steps):
        at, key = round((t_ms + k) * 1e6), struct.pack("<HB", index, sub)
        command = b"\x21" if end == SEVERAL else b"\x23" if sub or index == 0x1010 else b"\x2f"
        answer = b"\x60" + key + bytes(4)
        if isinstance(end, int):
            answer = b"\x80" + key + end.to_bytes(4, "little")
        if end != UNSEEN:
            data = command + key + value.to_bytes(4, "little")
            rows.append(frame(at, 0x600 + node, data))
        if end != LOST:
            rows.append(frame(at + 300_000, 0x580 + (server or node), answer))
    return rows


def words(node: int, *objects: int, ends=(), count: int = 0):
    """Writes that map objects to the first PDO of a node; `ends` by sub-index of 1A00h."""
    ends = dict(ends)
    return [
        (0x1800, 1, 0x80000180 + node, ends.get(-1, OK)),
        (0x1A00, 0, 0, OK),
        *((0x1A00, k, word, ends.get(k, OK)) for k, word in enumerate(objects, 1) if word),
        (0x1A00, 0, count or len(objects), ends.get(0, OK)),
        (0x1800, 1, 0x180 + node, OK),
    ]


WHOLE = (STATUS, POSITION, DEMAND)
USUAL = [row for node in (1, 2) for row in talk(100 * node, node, *words(node, *WHOLE))]
SECOND = talk(200, 2, *words(2, *WHOLE))  # of the second node only
STORED = (0x1010, 1, 0x65766173, OK)


def boot(t_ms: float, node: int) -> list:
    return [frame(round(t_ms * 1e6), 0x700 + node, b"\0")]


def reset(t_ms: float, node: int, command: int = 0x81) -> list:
    return [frame(round(t_ms * 1e6), 0, bytes([command, node]))]


def of(before, robot=ROBOT, behind=()) -> Decoded:
    """The samples of a session with frames before and behind it."""
    frames = np.concatenate([block(list(before)), flat(session()), block(list(behind))])
    mapped, bus = resolve_mapped(frames, robot, "robot.toml")
    return decode(mapped, robot, bus, "log")


def all_true(found: Decoded) -> None:
    """50 rows with the positions and demands that the drives had."""
    raw = [
        found.samples["position"] * 50 * 65536 / (2 * np.pi),
        found.samples["effort"] / (0.42e-3 * 50),
    ]
    wanted = (
        [[counts(node, k) for node in (1, 2)] for k in range(50)],
        [[10 * node + k for node in (1, 2)] for k in range(50)],
    )
    for seen, true in zip(raw, wanted, strict=True):
        assert np.rint(seen).astype(int).tolist() == true


def reads(node: int) -> list:
    """A master that only reads what is mapped."""
    rows, values = [], [(0x1800, 1, 0x180 + node), (0x1A00, 0, 3)]
    values += [(0x1A00, k, word) for k, word in enumerate(WHOLE, 1)]
    for k, (index, sub, value) in enumerate(values):
        at, key = round((100 * node + k) * 1e6), struct.pack("<HB", index, sub)
        rows.append(frame(at, 0x600 + node, b"\x40" + key + bytes(4)))
        data = b"\x43" + key + value.to_bytes(4, "little")
        rows.append(frame(at + 300_000, 0x580 + node, data))
    return rows


def doubled(rows, after_ns: int) -> list:
    """Each frame of SDO again."""
    return [x for row in rows for x in (row, (row[0] + after_ns, *row[1:]))]


MORE = [(0x1A00, 3, ACTUAL, CANNOT_BE_MAPPED)]
CONFIRMED = {
    "confirmed": USUAL,
    "another write is refused": USUAL + talk(300, 1, *MORE),
    "all of another mapping is refused": USUAL
    + talk(300, 1, *((i, s, v, 0x08000022) for i, s, v, _ in words(1, ACTUAL, POSITION, STATUS))),
    "a read is refused": [
        *USUAL,
        frame(300_000_000, 0x581, bytes.fromhex("80 01 1A 00 00 00 02 06")),
    ],
    "read": reads(1) + reads(2),
    "written, then stored, then started": USUAL + talk(300, 1, STORED) + boot(400, 1),
    "stored, then reset with all": USUAL
    + talk(300, 1, STORED)
    + talk(320, 2, STORED)
    + reset(400, 0)
    + boot(401, 1),
    "started, then written": boot(10, 1) + boot(11, 2) + USUAL,
    "reset, then written": reset(10, 0, 0x82) + USUAL,
    "another node starts": USUAL + boot(400, 9) + reset(410, 9) + boot(420, 0),
    "no node is asked": [*USUAL, frame(400_000_000, 0x600, bytes.fromhex("2300 1A03 0000 0000"))],
    "frames that are too short for SDO": [
        *USUAL,
        frame(300_000_000, 0x601, bytes.fromhex("2F 00 1A 00")),
        frame(301_000_000, 0x581, bytes.fromhex("60 00 1A 00")),
    ],
    "another start of NMT": USUAL + reset(400, 0, 0x01),
    "each frame twice": doubled(USUAL, 50_000),
    "written again": USUAL
    + talk(300, 1, *words(1, ACTUAL, POSITION, STATUS))
    + talk(400, 1, *words(1, *WHOLE)),
    "of another node by its own answer": USUAL + talk(300, 9, (0x1A00, 3, ACTUAL, OK)),
}


@pytest.mark.parametrize("before", CONFIRMED.values(), ids=CONFIRMED)
def test_confirmed_mapping_is_used(before):
    found = of(before)
    all_true(found)
    assert found.warnings == ()


SAME = {
    "read": ([], reads(1) + reads(2)),
    "stored": (USUAL, talk(1100, 1, STORED)),
    "another mapping behind": (USUAL, talk(1100, 1, *words(1, ACTUAL, POSITION, STATUS))),
    "the same again": (USUAL, talk(1100, 1, (0x1A00, 3, DEMAND, OK))),
    "refused": (USUAL, talk(1100, 1, (0x1A00, 3, ACTUAL, CANNOT_BE_MAPPED))),
}


@pytest.mark.parametrize(("before", "behind"), SAME.values(), ids=SAME)
def test_ineffective_writes_keep_all_rows(before, behind):
    found = of(before, behind=behind)
    all_true(found)
    assert found.warnings == ()


NOT_KNOWN = {
    "answer lost": (words(1, *WHOLE, ends={2: LOST}), "1A00:2 was written, but no answer was seen"),
    "number lost": (words(1, *WHOLE, ends={0: LOST}), "1A00:0 was written, but no answer was seen"),
    "refused": (
        words(1, *WHOLE, ends={3: CANNOT_BE_MAPPED}),
        "1A00:3 was refused by the drive (0x06040041)",
    ),
    "write lost": (
        words(1, *WHOLE, ends={2: UNSEEN}),
        "1A00:2 was written, but the write was not seen",
    ),
    "in segments": (words(1, *WHOLE, ends={1: SEVERAL}), "1A00:1 was written in several frames"),
    "entry never written": (words(1, STATUS, 0, DEMAND), "1A00:2 is not known"),
    "more entries than written": (words(1, *WHOLE, count=4), "1A00:4 is not known"),
    "another object": (
        [*words(1, STATUS, POSITION, ACTUAL), (0x1A00, 3, DEMAND, CANNOT_BE_MAPPED)],
        "carries 6074:0: 1A00:3 was refused by the drive (0x06040041)",
    ),
}


@pytest.mark.parametrize(("steps", "expected"), NOT_KNOWN.values(), ids=NOT_KNOWN)
def test_unconfirmed_mapping_is_refused(steps, expected):
    with pytest.raises(BadInputError) as caught:
        of(talk(100, 1, *steps) + SECOND)
    assert expected in str(caught.value)
    assert str(caught.value).startswith("robot.toml: bus.drive[0].mapping")


STARTED = {
    "started": boot(400, 1),
    "reset": reset(400, 1),
    "reset of communication of all": reset(400, 0, 0x82),
    "storing is refused": talk(300, 1, (*STORED[:3], 0x08000020)) + boot(400, 1),
    "storing is not answered": talk(300, 1, (*STORED[:3], LOST)) + boot(400, 1),
    "other parameters stored": talk(300, 1, (0x1010, 3, 0x65766173, OK)) + boot(400, 1),
    "defaults restored": talk(300, 1, STORED, (0x1011, 1, 0x64616F6C, OK)) + boot(400, 1),
}


@pytest.mark.parametrize("behind", STARTED.values(), ids=STARTED)
def test_restart_clears_unstored_mapping(behind):
    with pytest.raises(BadInputError, match="6064:0: 1800:1 was lost at a start of the drive"):
        of(USUAL + behind)


def test_answers_of_other_node_do_not_confirm():
    with pytest.raises(BadInputError, match="1800:1 was written, but no answer was seen"):
        of(talk(100, 1, *words(1, *WHOLE), server=3) + SECOND)


def test_answer_after_lost_write_is_no_duplicate():
    """The second write of 1A00:3 is lost; an answer 0.7 ms later is no doubled frame."""
    rows = talk(100, 1, *words(1, *WHOLE), (0x1A00, 3, DEMAND, OK), (0x1A00, 3, ACTUAL, UNSEEN))
    with pytest.raises(BadInputError, match="1A00:3 was written, but the write was not seen"):
        of(rows + SECOND)


def test_without_answers_writes_count_with_warning():
    silent = [row for row in USUAL if row[1] > 0x600]
    for found in (of(silent), of(silent, behind=boot(1101, 2))):
        all_true(found)
        assert found.warnings == (SILENT,)
    # It may end before the first PDO.
    assert resolve_mapped(block(silent), ROBOT, "robot.toml")[1].drives[1].tpdos
    with pytest.raises(BadInputError, match="6064:0: 1800:1 was lost at a start of the drive"):
        of(silent + boot(400, 2))


def moved(intervals, t_ns: int) -> list:
    """Frames of a mapping with the demand in place of the status."""
    return [
        (t + t_ns, can_id, n, flags, np.concatenate([data[6:], data[2:6], data[:2]]))
        if can_id > 0x180
        else (t + t_ns, can_id, n, flags, data)
        for rows in intervals
        for t, can_id, n, flags, data in rows
    ]


def test_pdos_of_other_mapping_are_skipped():
    """Drives that run since before the log, and are mapped anew; that start again behind it."""
    early = moved(session(syncs=20), -1_000_000_000)
    behind = reset(1101, 2) + moved(session(syncs=10), 110_000_000) + boot(1200, 2)
    for before, after, count in ((early, [], 40), ([], behind, 20), (early, behind, 60)):
        found = of(before + USUAL, behind=after)
        all_true(found)
        assert found.warnings == (
            f"{count} of {100 + count} {LEFT_OUT}, or one that was not logged",
        )


def test_differently_confirmed_mapping_warns():
    others = {1: DEMAND, 3: STATUS}
    wrong = talk(100, 1, *words(1, DEMAND, POSITION, STATUS)) + SECOND
    told = [
        f"bus.drive[0]: motor_1 confirmed 1A00:{k} = 0x{word:X}, which is not tpdo 1 (0x181) by "
        "mapping = 'table': correct it"
        for k, word in others.items()
    ]
    for behind in ([], boot(1101, 1)):
        assert list(of(wrong, TABLE, behind).warnings) == told
    refused = words(1, ACTUAL, POSITION, STATUS, ends={1: 0x06040041, 3: 0x06040041})
    for before in (USUAL, [], USUAL + talk(300, 1, *refused)):
        found = of(before, TABLE)
        all_true(found)
        assert found.warnings == ()
