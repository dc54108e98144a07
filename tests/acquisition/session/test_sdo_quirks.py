"""Drives whose SDO servers differ: `check` says for recording and motion what the session then
does, and a drive that has what is needed is left as it is.
"""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial

import pytest
from dry_sessions import FaultyDrives, connected, dry_session, swing
from made_up_buses import bus_of, bus_text, robot_of
from virtual_buses import bus_file

from acquisition.bus import Uploads, is_homed, scan_nodes
from acquisition.commands.checking import check_drives, verdicts
from acquisition.commands.scanning import ARRAYS, OBJECTS, findings_of
from acquisition.protocol import (
    BITS,
    PARAMETERS,
    DictionaryEntry,
    ObjectDictionary,
    abort_answer,
    request_of,
)
from acquisition.robot import Bus
from acquisition.session import RecordOptions, Task
from acquisition.session.running import _before_motion as before_motion
from acquisition.simulated import SimulatedNode

Serve = Callable[[SimulatedNode, bytes, bytes], bytes]
Key = tuple[int, int]
OFF, PERIOD = 1 << 31, 0x60C2
MAPPING = {*range(0x1600, 0x1604), *range(0x1A00, 0x1A04)}


def usual(node: SimulatedNode, data: bytes, answer: bytes) -> bytes:
    return answer


def refusing(kind: str, meaning: str, *indices: int) -> Serve:
    """Reads or writes of these objects are aborted."""

    def serve(node, data, answer):
        asked = request_of(data)
        refused = asked.kind in kind and asked.index in indices
        return abort_answer(asked.index, asked.sub, meaning) if refused else answer

    return serve


def absent(*indices: int) -> Serve:
    return refusing("read write", "object does not exist", *indices)


def read_only(*indices: int) -> Serve:
    return refusing("write", "write to a read-only object", *indices)


def always(first: int, padding: bytes) -> Serve:
    """Values have four bytes behind the command `first`; a write needs the object's own size."""

    def serve(node, data, answer):
        asked = request_of(data)
        size = BITS[node.types.get((asked.index, asked.sub), "U32")] // 8
        if asked.kind == "write" and len(asked.data) != size:
            return abort_answer(asked.index, asked.sub, "length does not match")
        value = bytes([first]) + answer[1 : 4 + size] + padding[: 4 - size]
        return value if answer[0] >> 5 == 2 else answer

    return serve


def no_more_than_counted(node: SimulatedNode, data: bytes, answer: bytes) -> bytes:
    """A mapping has no sub-index beyond its count."""
    asked = request_of(data)
    beyond = asked.index in MAPPING and asked.sub > node.values[asked.index, 0]
    reads = asked.kind == "read" and beyond
    return abort_answer(asked.index, asked.sub, "sub-index does not exist") if reads else answer


def remote_requests_stay_off(node: SimulatedNode, data: bytes, answer: bytes) -> bytes:
    """Bit 30 of a COB-ID cannot be cleared (CiA 301, 7.5.2.35)."""
    asked = request_of(data)
    clears = asked.kind == "write" and asked.index == 0x1800 and asked.sub == 1
    clears &= not asked.number >> 30 & 1
    return abort_answer(asked.index, asked.sub, "value out of range") if clears else answer


def wide_heartbeat(node: SimulatedNode, data: bytes, answer: bytes) -> bytes:
    node.types[0x1017, 0] = "U32"
    asked = request_of(data)
    short = asked.kind == "write" and asked.index == 0x1017 and len(asked.data) != 4
    return abort_answer(asked.index, asked.sub, "length does not match") if short else answer


def as_described(node: SimulatedNode) -> None:
    """PDOs and heartbeat as the description has them, before the session."""
    for way, pdos in (("tpdo", node.drive.tpdos), ("rpdo", node.drive.rpdos)):
        for pdo in pdos:
            communication, mapping = (first + pdo.number - 1 for first in PARAMETERS[way])
            node.values |= {(communication, 1): pdo.can_id, (communication, 2): 1}
            node.values |= {(mapping, k): e.mapping for k, e in enumerate(pdo.entries, 1)}
            node.values[mapping, 0] = len(pdo.entries)
    node.values |= {(0x1017, 0): 100, (PERIOD, 1): 2, (PERIOD, 2): -3, (0x6060, 0): 8}
    node.values[0x6061, 0] = 8


def values(
    stated: Mapping[Key, int], *, described: bool = False
) -> Callable[[SimulatedNode], None]:
    def set_values(node: SimulatedNode) -> None:
        if described:
            as_described(node)
        node.types |= dict.fromkeys(stated.keys() - node.types, "U32")
        node.values |= stated

    return set_values


def nothing(node: SimulatedNode) -> None:
    pass


FIXED = read_only(*MAPPING)
LIMIT = round(150 / 360 * 50 * 65536)  # 150 deg at a ratio of 50 and 65536 counts a turn
RANGE = ((0x607D, 1), (0x607D, 2))
# what is special, the values before, and the object that forbids recording and motion, if any
QUIRKS: dict[str, tuple[Serve, Callable[[SimulatedNode], None], str, str]] = {
    "usual": (usual, nothing, "", ""),
    "a fixed mapping, as described": (FIXED, as_described, "", ""),
    "a fixed mapping, off and not at SYNC": (
        FIXED, values({(0x1800, 1): 0x181 | OFF, (0x1800, 2): 255, (0x1400, 1): 0x333},
                      described=True), "", ""),
    "everything as needed, and nothing can be written": (
        read_only(*MAPPING, 0x1400, 0x1800, 0x1017, PERIOD, 0x6060), as_described, "", ""),
    "no sizes": (always(0x42, b"\xa5\xa5\xa5"), nothing, "", ""),
    "always four bytes": (always(0x43, bytes(3)), nothing, "", ""),
    "always four bytes, any behind the value": (always(0x43, b"\xff\xff\xff"), nothing, "", ""),
    "no heartbeat time": (absent(0x1017), nothing, "", "heartbeat 1017"),
    "a heartbeat time of four bytes": (wide_heartbeat, nothing, "", ""),
    "no interpolation period": (absent(PERIOD), nothing, "", "interpolation period 60C2"),
    "the period in another unit, fixed": (
        read_only(PERIOD), values({(PERIOD, 1): 20, (PERIOD, 2): -4}), "", ""),
    "no mode display": (absent(0x6061), nothing, "", "mode and display 6060 6061"),
    "a mode that can only be written": (
        refusing("read", "read of a write-only object", 0x6060), nothing, "", ""),
    "bit 30 of a COB-ID is fixed": (
        remote_requests_stay_off, values({(0x1800, 1): 0x40000181 | OFF}), "", ""),
    "no sub-index beyond the count": (no_more_than_counted, nothing, "", ""),
    "no such PDO": (absent(0x1800), nothing, "TPDO 1 1800 1A00", "TPDO 1 1800 1A00"),
    "no PDO to the drive": (absent(0x1400), nothing, "", "RPDO 1 1400 1600"),
    "no rated torque": (absent(0x6076), nothing, "rated value 6076:0", "rated value 6076:0"),
    "no consumer heartbeat": (absent(0x1016), nothing, "", ""),
    "no limits, no gear, no units": (absent(0x607D, 0x6080, 0x6091, 0x60A9), nothing, "", ""),
    "such objects are a general error": (
        refusing("read", "general error", 0x607D, 0x6080, 0x6091, 0x60A9), nothing, "", ""),
    "a gear of 100, with a ratio of 50": (
        usual, values({(0x6091, 1): 100}), "", "gear 6091"),
    "a gear of 25, and a belt": (usual, values({(0x6091, 1): 25}), "", ""),
    "a range 10 degrees narrower": (
        usual, values({RANGE[0]: -LIMIT, RANGE[1]: LIMIT * 14 // 15}), "", "position limits 607D"),
    "a range narrower from below": (
        usual, values({RANGE[0]: -LIMIT * 14 // 15, RANGE[1]: LIMIT}), "", "position limits 607D"),
    "a range from a home that is elsewhere": (
        usual, values({RANGE[0]: -LIMIT, RANGE[1]: LIMIT * 14 // 15, (0x607C, 0): 90_000}), "", ""),
    "no range": (usual, values(dict.fromkeys(RANGE, 0)), "", ""),
    # 200 deg/s at a ratio of 50 are 1667 rpm
    "a quick stop of 1900 deg/s2": (
        usual, values({(0x6085, 0): round(1900 / 360 * 50 * 65536)}), "",
        "quick stop deceleration"),
    "a motor that is slower": (usual, values({(0x6080, 0): 1600}), "", "motor speed 6080"),
    "a speed in turns per second": (
        usual, values({(0x6080, 0): 30, (0x60A9, 0): 0x00B40300}), "", ""),
    "a fast motor": (usual, values({(0x6080, 0): 50_000}), "", ""),
    "a fast motor with a wide range": (
        usual, values({(0x6080, 0): 50_000, RANGE[0]: -3 * LIMIT, RANGE[1]: 3 * LIMIT}), "", ""),
    "range and speed of a ratio of 150": (
        usual, values({(0x6080, 0): 5000, RANGE[0]: -3 * LIMIT, RANGE[1]: 3 * LIMIT}), "",
        "ratio 607D 6080"),
}  # fmt: skip


class Quirky(FaultyDrives):
    """Node 2 is the one that differs."""

    change: Callable[[SimulatedNode], None] = nothing
    other: Callable[[SimulatedNode], None] = nothing

    def __init__(self, *arguments, **options):
        super().__init__(*arguments, **options)
        self.nodes[1].types.setdefault((0x60A9, 0), "U32")
        for node, prepare in zip(self.nodes, (type(self).other, type(self).change), strict=True):
            prepare(node)
            node.initial = dict(node.values)
            node._map()


def quirky(
    monkeypatch: pytest.MonkeyPatch,
    serve: Serve,
    change: Callable[[SimulatedNode], None],
    other: Callable[[SimulatedNode], None] = nothing,
) -> type[Quirky]:
    own = SimulatedNode._serve

    def served(node: SimulatedNode, data: bytes) -> bytes:
        answer = own(node, data)
        return serve(node, data, answer) if node.drive.node == 2 else answer

    monkeypatch.setattr(SimulatedNode, "_serve", served)
    monkeypatch.setattr("acquisition.session.session.HOLD_S", 0.0)  # of each of many sessions
    return type(
        "Changed", (Quirky,), {"change": staticmethod(change), "other": staticmethod(other)}
    )


def agreed(tmp_path, kind: type[Quirky], bus=None, robot=None) -> dict[str, str]:
    """Verdicts of `check`, which only reads, once each session has ended as they say."""
    robot = robot or robot_of(bus_text(2, extra="enable_watch_s = 0.05"))
    run, _ = connected(robot, kind)
    sent, send = [], run.send
    run.send = lambda can_id, data: (sent.append((can_id, data[:1])), send(can_id, data))
    said = verdicts(check_drives(run, bus or bus_of(robot)))
    assert {frame for frame in sent if frame[0] != 0x80} <= {(0x601, b"\x40"), (0x602, b"\x40")}
    tasks = {"recording": Task(duration_s=0.1)}
    ready = partial(before_motion, robot, options=RecordOptions(), confirm=lambda *_: True)
    tasks["motion"] = Task(
        reference=swing(2, seconds=0.2, amplitude=0.02), before_motion=lambda master: ready(master)
    )
    for name, task in tasks.items():
        done = dry_session(
            tmp_path / f"{name}.mcap", task, robot=robot, bus=bus, drives=run.drives.bus,
            simulated=kind,
        )  # fmt: skip
        assert (done.outcome.reason == "finished") == (said[name] == "passed"), done.outcome.reason
        if said[name] != "passed":
            assert done.sent["can_id"].max(initial=0) <= 0x602
            assert set(done.sent["data"][:, 0].tolist()) == {0x40}  # nothing was written
            assert all(
                f"node 2 (motor_2): {text}" in done.outcome.reason for text in objects(said[name])
            )
    return said


def objects(verdict: str) -> list[str]:
    names = verdict.removeprefix("failed: ").split(", ")
    return [] if verdict == "passed" else [name.removesuffix(" of node 2") for name in names]


@pytest.mark.parametrize("name", QUIRKS)
def test_check_agrees_with_record(name, tmp_path, monkeypatch):
    serve, change, recording, motion = QUIRKS[name]
    said = agreed(tmp_path, quirky(monkeypatch, serve, change))
    assert [" ".join(objects(said[task])) for task in ("recording", "motion")] == [
        recording,
        motion,
    ]


def with_dictionary(entries: Mapping[Key, DictionaryEntry]) -> Bus:
    """The bus of two drives whose dictionaries have these entries."""
    bus = bus_of(robot_of(bus_text(2)))
    usual = dict.fromkeys(((0x6076, 0), (0x6065, 0)), entry("U32"))
    known = ObjectDictionary(entries=usual | entries, vendor=0, product=0)
    drives = tuple(dataclasses.replace(drive, dictionary=known) for drive in bus.drives)
    return dataclasses.replace(bus, drives=drives)


def entry(kind: str, *, writable: bool = True, value: int | None = None) -> DictionaryEntry:
    return DictionaryEntry(type=kind, writable=writable, value=value)


CONST, PERIOD_MS = entry("U32", writable=False), {(PERIOD, 2): entry("I8", value=-3)}
DICTIONARIES = {
    # Node 2 has no 60C2h of its own: its dictionary says 2 ms, 5 ms, or nothing.
    "its dictionary's period": (
        absent(PERIOD), {(PERIOD, 1): entry("U8", value=2), **PERIOD_MS}, "", ""),
    "another period by its dictionary": (
        absent(PERIOD), {(PERIOD, 1): entry("U8", value=5), **PERIOD_MS}, "",
        "interpolation period 60C2"),
    "no period in its dictionary": (
        absent(PERIOD), {(PERIOD, 1): entry("U8"), **PERIOD_MS}, "", "interpolation period 60C2"),
    "another period, which the drive itself says": (
        usual, {(PERIOD, 1): entry("U8", value=5), **PERIOD_MS}, "", ""),
    "a fixed mapping that is another": (
        usual, {(0x1A00, 0): CONST, (0x1A00, 1): CONST}, "TPDO 1 1800 1A00", "TPDO 1 1800 1A00"),
    "a fixed mapping to the drive": (usual, {(0x1600, 1): CONST}, "", "RPDO 1 1400 1600"),
    "a fixed time of the heartbeat": (usual, {(0x1017, 0): CONST}, "", "heartbeat 1017"),
}  # fmt: skip


@pytest.mark.parametrize("name", DICTIONARIES)
def test_dictionary_shows_fixed_and_unreadable(name, tmp_path, monkeypatch):
    serve, entries, recording, motion = DICTIONARIES[name]
    kind = quirky(monkeypatch, serve, nothing, as_described)
    said = agreed(tmp_path, kind, with_dictionary(entries))
    assert [", ".join(objects(said[task])) for task in ("recording", "motion")] == [
        recording,
        motion,
    ]


def test_unsettable_heartbeat_is_not_awaited(tmp_path, monkeypatch):
    """Heartbeats each 5 s, where 0.3 s without one are a fault, for a recording of 1 s."""
    kind = quirky(monkeypatch, read_only(0x1017), values({(0x1017, 0): 5000}))
    done = dry_session(tmp_path / "a.mcap", Task(duration_s=1.0), simulated=kind)
    assert done.outcome.reason == "finished"
    (warning,) = done.events("warning")
    assert warning.startswith("node 2: object 1017:0 = 100: the drive refused the access: write")
    assert len(done.recording.samples) > 450
    track = Task(reference=swing(2, seconds=0.3, amplitude=0.02))
    done = dry_session(tmp_path / "b.mcap", track, simulated=kind)
    assert "1017:0 = 100: the drive refused the access" in done.outcome.reason
    assert done.events("phase") == ["configure"]


@pytest.mark.parametrize(
    ("changed", "written"),
    [
        ({}, []),
        ({(0x1017, 0): 0}, ["1017:0"]),
        ({(0x1800, 2): 255}, ["1800:1", "1800:2", "1800:1"]),
        ({(0x1800, 1): 0x481}, ["1800:1", "1800:1"]),
        ({(0x1A00, 3): 0x60770010},
         ["1800:1", "1A00:0", "1A00:1", "1A00:2", "1A00:3", "1A00:0", "1800:1"]),
        # the count alone: the last object is not sent
        ({(0x1A00, 0): 2},
         ["1800:1", "1A00:0", "1A00:1", "1A00:2", "1A00:3", "1A00:0", "1800:1"]),
        ({(0x1400, 2): 255}, []),  # a recording sends no PDO
    ],
)  # fmt: skip
def test_only_differences_are_written(changed, written, tmp_path, monkeypatch):
    """In the order of CiA 301: off, the objects, their number, at every SYNC, on."""
    kind = quirky(monkeypatch, usual, values(changed, described=True), as_described)
    done = dry_session(tmp_path / "a.mcap", Task(duration_s=0.1), simulated=kind)
    assert done.outcome.reason == "finished"
    requests = [request_of(row["data"].tobytes()) for row in done.sent if row["can_id"] == 0x602]
    assert [f"{x.index:04X}:{x.sub}" for x in requests if x.kind == "write"] == written
    assert len(done.recording.samples) > 40


@pytest.mark.parametrize(
    ("stated", "motion"),
    [
        ({}, []),
        # Its motor moves both joints: no ratio is that of its gear.
        ({(0x6091, 1): 1000}, []),
        ({(0x6080, 0): 10_000, RANGE[0]: -6 * LIMIT, RANGE[1]: 6 * LIMIT}, []),
        # 150 deg of both joints at 50 each: twice LIMIT is needed, and twice 1667 rpm
        ({(0x6080, 0): 3333, RANGE[0]: -2 * LIMIT, RANGE[1]: 2 * LIMIT}, []),
        ({RANGE[0]: -2 * LIMIT, RANGE[1]: 19 * LIMIT // 10}, ["position limits 607D"]),
        ({(0x6080, 0): 3250}, ["motor speed 6080"]),
    ],
)
def test_coupled_motor_has_limits_of_both_joints(stated, motion, monkeypatch):
    text = bus_text(2).replace("ratio = 50.0\n", "")
    robot = robot_of("motor_matrix = [[50, 0], [50, 50]]\n" + text)
    run, _ = connected(robot, quirky(monkeypatch, usual, values(stated)))
    assert objects(verdicts(check_drives(run, bus_of(robot)))["motion"]) == motion


@pytest.mark.parametrize(("kind", "homed"), [("U8", False), ("U16", True)])
def test_given_objects_have_given_types(kind, homed, monkeypatch):
    """2000:1 is 0 in its first byte, and the drive pads it to four bytes of FFh."""
    text = bus_text(2, drive=f'homed = "2000:1"\nobjects = {{ "2000:1" = "{kind}" }}')
    padded = quirky(monkeypatch, always(0x43, b"\xff\xff\xff"), nothing)
    run, master = connected(robot_of(text), padded)
    run.drives.nodes[1].types[0x2000, 1] = "U8"
    run.drives.nodes[1].values[0x2000, 1] = 0
    assert is_homed(master, master.bus.drives[1]) is homed


def test_scan_accepts_answers_without_size(monkeypatch):
    quirky(monkeypatch, always(0x42, b"\xa5\xa5\xa5"), nothing)
    run, _ = connected(robot_of(bus_text(2)))
    nodes = scan_nodes(Uploads(run, bus_file()), OBJECTS, ARRAYS)
    assert nodes[2] == nodes[1]
    assert [row.found for row in findings_of(nodes, {}) if not row.ok] == []
