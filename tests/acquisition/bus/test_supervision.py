"""What drives notice of a master that dies: its heartbeat, their consumers of it, and
what check tells of them.
"""

import itertools
from contextlib import nullcontext
from functools import partial

import msgspec
import pytest
from dry_sessions import (
    SyncOfAnother,
    at_boot,
    connected,
    dry_session,
    enable,
    findings,
    swing,
)
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import (
    Master,
    MasterHeartbeat,
    free_entry,
    read_needs,
    refuse_unsupervised,
    second_stop,
    supervision_of,
    timeout_ms,
)
from acquisition.errors import RefusedError
from acquisition.protocol import State
from acquisition.session import Task
from acquisition.simulated import LockStepLink
from acquisition.simulated import node as simulated_supervision

MS = 1_000_000
TRACK = Task(reference=swing(2, seconds=0.5, amplitude=0.1))
# 1016h:1 = 127 << 16 | 300 ms as an expedited SDO of four bytes (CiA 301, 7.2.4 and
# 7.5.2.17), and its removal.
ASKED, REMOVED = bytes.fromhex("231610012c017f00"), bytes.fromhex("2316100100000000")


def test_tracking_is_monitored_from_start_to_end(tmp_path):
    session = dry_session(tmp_path / "a.mcap", TRACK)
    assert session.outcome.reason == "finished"
    frames = session.frames
    beats = frames[frames["can_id"] == 0x77F]
    assert {bytes(d[:n]) for d, n in zip(beats["data"], beats["length"], strict=True)} == {b"\x05"}
    syncs = frames["time_ns"][frames["can_id"] == 0x80]
    # Three in every time-out of 300 ms, from the first SYNC on; none between SYNCs
    # but those of the end.
    times = beats["time_ns"].tolist()
    assert times[0] == syncs[0]
    assert max(b - a for a, b in itertools.pairwise(times)) <= 100 * MS
    assert set(times[:-2]) <= set(syncs.tolist())
    for node in (1, 2):
        written = (frames["data"][:, 0] == 0x23) & (frames["data"][:, 1] == 0x16)
        asked = frames[(frames["can_id"] == 0x600 + node) & written]
        assert [d.tobytes() for d in asked["data"]] == [ASKED, REMOVED]
        removed_ns = asked["time_ns"][1]
        assert removed_ns >= session.recording.events[-1].stamp_ns - 100 * MS
        assert removed_ns - times[-1] < 300 * MS  # it ends before the time-out is over
    assert [node.values[0x1016, 1] for node in session.drives.nodes] == [0, 0]
    assert not (frames["can_id"] == 0x81).any()


def enabled(
    *, abort_connection: int = 1, supervised: bool = True
) -> tuple[LockStepLink, Master, MasterHeartbeat]:
    """Two drives in operation enabled, whose master has sent one heartbeat and
    now says nothing more.
    """
    run, master = connected(supervised=supervised)
    heartbeat = MasterHeartbeat(master)
    heartbeat.request()
    for node in run.drives.nodes:
        node.values[0x6007, 0] = abort_connection
    enable(master)
    master.sync()
    master.wait(run.now_ns() + MS)
    return run, master, heartbeat


@pytest.mark.parametrize(
    ("option", "state"),
    list(
        enumerate(
            (
                State.OPERATION_ENABLED,
                State.FAULT,
                State.SWITCH_ON_DISABLED,
                State.QUICK_STOP_ACTIVE,
            )
        )
    ),
)
def test_lost_heartbeat_reaction_follows_6007(monkeypatch, option, state):
    monkeypatch.setattr(simulated_supervision, "SYNC_LOST_NS", 3600 * 10**9)
    run, master, _ = enabled(abort_connection=option)
    master.wait(run.now_ns() + 298 * MS)
    assert run.drives.states == [State.OPERATION_ENABLED] * 2
    assert master.nodes[0].emergency is None
    master.wait(run.now_ns() + 3 * MS)
    assert run.drives.states == [state] * 2
    assert master.nodes[0].emergency == 0x8130


def test_unmonitored_drive_stays_enabled():
    run, master, heartbeat = enabled(abort_connection=0, supervised=False)
    assert ["does not exist" in text for text in heartbeat.request()] == [
        True,
        True,
    ]
    master.wait(run.now_ns() + 2000 * MS)
    assert run.drives.states == [State.OPERATION_ENABLED] * 2


def test_foreign_sync_paces_heartbeat():
    run, master = connected(robot_of(bus_text(2, extra='sync_producer = "other"')))
    MasterHeartbeat(master).request()
    enable(master)
    master.link = SyncOfAnother(link=run, next_ns=run.now_ns() + 2 * MS)
    for _ in range(201):  # 0.4 s: the time-out is 0.3 s
        assert master.wait_for_sync(run.now_ns() + 4 * MS)
        master.wait(run.now_ns() + MS)
        run.drives.silent.add(1)  # after its first answer; the last SYNC is not yet judged
    assert run.drives.states[0] is State.OPERATION_ENABLED
    assert [watch.silent_syncs for watch in master.nodes] == [0, 199]


def test_boot_up_is_restart_and_heartbeat_is_not():
    run, master = connected()
    run.drives.set_heartbeats(100)  # after a restart too
    enable(master)
    restarted = []
    for command in (None, 129, None):  # 129: reset node (CiA 301, 7.2.8.3.1)
        if command:
            master.nmt(command, 1)
        master.wait(run.now_ns() + 300 * MS)
        restarted.append([watch.booted for watch in master.nodes])
    assert restarted == [[False, False], [True, False], [True, False]]


def test_foreign_heartbeat_consumers_are_kept(tmp_path, monkeypatch):
    other, ours = 5 << 16 | 700, 127 << 16 | 300

    def entries(node):
        node.values |= {
            (0x1016, 1): other,
            (0x1016, 2): other + 0x10000 if node.drive.node == 1 else ours,
        }

    at_boot(monkeypatch, entries)
    session = dry_session(tmp_path / "a.mcap", TRACK)
    assert session.outcome.reason == "finished"
    full, left = session.drives.nodes
    assert (full.values[0x1016, 1], full.values[0x1016, 2]) == (other, other + 0x10000)
    assert (left.values[0x1016, 1], left.values[0x1016, 2]) == (other, 0)
    (warning,) = [text for text in session.events("warning") if "1016" in text]
    assert warning.startswith("node 1: object 1016: no sub-index is free")


@pytest.mark.parametrize(
    ("entries", "sub"),
    [([], None), ([0], 1), ([5 << 16 | 100, 0], 2), ([5 << 16 | 100, 5 << 16], 2),
     ([0, 127 << 16 | 90], 2),
     ([127 << 16, 0], 1), ([5 << 16 | 100], None), ([200 << 16 | 100], 1)],
)  # fmt: skip
def test_free_consumer_entry(entries, sub):
    assert free_entry(entries, 127) == sub


def test_timeout_is_three_heartbeats_or_periods():
    assert timeout_ms(bus_of(robot_of(bus_text(2))).file) == 300
    assert timeout_ms(bus_of(robot_of(bus_text(2, extra="heartbeat_s = 0.01"))).file) == 30
    assert (
        timeout_ms(bus_of(robot_of(bus_text(2, period_s=0.02, extra="heartbeat_s = 0.01"))).file)
        == 60
    )


refuse_slow = partial(read_needs, track=True)
RAMPS = dict(
    enumerate(
        ("slow-down deceleration", "quick stop deceleration", "current limit", "voltage limit"), 1
    )
)
HELD = {k + 4: f"{ramp}, then held in quick stop active" for k, ramp in RAMPS.items()}
OFF = {0: "voltage off at once, the motor coasts", -1: "manufacturer-specific"}
OFF |= {k: f"{ramp}, then off" for k, ramp in RAMPS.items()}


@pytest.mark.parametrize(
    ("values", "missing", "expected"),
    [
        *(({(index, 0): k % 2**16}, (), f"{index:04X} = {k}: {words}")
          for index, options in ((0x605A, OFF | HELD), (0x605E, OFF))
          for k, words in options.items()),
        ({(0x6007, 0): 0}, (), "6007 = 0: a lost heartbeat has no effect"),
        ({(0x1016, 1): 5 << 16 | 80}, (), "1016 = node 5 80 ms; motion writes 0x007F012C (node "
                                          "127, 300 ms) to sub-index 2"),
        ({(0x1016, 0): 0}, (), "1016 = none in use; no sub-index is free, so the drive does not "
                               "detect the loss of the master"),
        ({}, (0x1016,),
         "1016 = does not exist, so the drive does not detect the loss of the master"),
        ({(0x1029, 1): 0}, (), "1029:1 = 0: pre-operational"),
        ({(0x1400, 5): 0}, (), "1400:5 = 0: a missing PDO to the drive has no effect"),
        ({}, (0x605E,), "fault reaction 605E = does not exist"),
        ({(0x6065, 0): 2**32 - 1}, (), "following error 6065 = 0xFFFFFFFF: off"),
        ({(0x6065, 0): 900, (0x6066, 0): 20}, (), "6065 = 900: an error of more than 900 position "
                                                  "units of the drive, after 20 ms"),
    ],
)  # fmt: skip
def test_monitoring_words(values, missing, expected):
    run, master = connected(robot_of(bus_text(1)))
    node = run.drives.nodes[0]
    node.types |= {(0x1029, 1): "U8", (0x1400, 5): "U16"}
    node.values |= {(0x1029, 1): 1, (0x1400, 5): 0} | values
    node.values = {key: value for key, value in node.values.items() if key[0] not in missing}
    shown = [" = ".join(pair) for pair in supervision_of(master, master.bus.drives[0])]
    assert any(expected in line for line in shown)


HALF = 18_204_444  # of 4000 deg/s² at a ratio of 50 and 65536 counts a turn, in whole counts/s²
UNLIMITED = bus_text(2).replace("acceleration_deg_s2 = 4000\n", "")
OFF_6065 = {0x6065: 2**32 - 1}


@pytest.mark.parametrize(
    ("refuse", "values", "text", "words"),
    [
        (refuse_slow, {0x605A: 2, 0x6085: HALF}, bus_text(2), ()),
        (refuse_slow, {0x605A: 2, 0x6085: HALF - 1}, bus_text(2),
         ("quick stop deceleration: 2000 deg/s², 0.1 s from", "expected at least 2000")),
        (refuse_slow, {0x605A: 2, 0x6085: 1}, UNLIMITED, ()),
        (refuse_slow, {0x605A: 3}, bus_text(2), ()),  # unknown
        (refuse_unsupervised, {}, bus_text(2), ()),
        (refuse_unsupervised, OFF_6065, bus_text(2),
         ("the following error is not monitored (6065",)),
        (refuse_unsupervised, OFF_6065 | {0x1016: 0, 0x6007: 0}, bus_text(2),
         ("a lost master has no effect (1016 has no free entry",
          "the following error is not monitored (6065")),
    ],
)  # fmt: skip
def test_motion_needs_fast_stop_and_monitoring(refuse, values, text, words):
    run, master = connected(robot_of(text))
    run.drives.nodes[1].values |= {(index, 0): value for index, value in values.items()}
    with pytest.raises(RefusedError) if words else nullcontext() as caught:
        refuse(master)
    assert all(word in str(caught.value) for word in words and ("node 2 (motor_2)", *words))


def test_check_shows_monitoring_and_watchdog():
    run, master = connected()
    (reaction,) = findings(run, master.bus, "reaction 6007", 2)
    assert reaction.found.startswith("1: fault")
    assert second_stop(master.bus.file).startswith("the recorder's process stops the drives")
    assert second_stop(msgspec.structs.replace(master.bus.file, interface="slcan")).startswith(
        "none, because slcan can be opened only once"
    )


def test_simulated_drive_stops_at_following_error():
    """Twice the joint's 5 degrees at a ratio of 50 and 65536 counts a turn: 91 022 counts."""
    run, _, _ = enabled()
    node = run.drives.nodes[0]
    assert node.values[0x6065, 0] == 91_022
    supervision = run.drives._supervisions[0]
    assert (supervision.follow(91_022), node.state) == ([], State.OPERATION_ENABLED)
    assert supervision.follow(-91_023) == [(0x81, bytes.fromhex("1186010000000000"))]
    assert node.state is State.FAULT
