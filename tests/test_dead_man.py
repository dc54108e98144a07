"""The recorder's process stops the drives of a session that dies or hangs; `disable` stops those of anybody."""

import multiprocessing
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from made_up_buses import bus_of, bus_text, robot_of
from test_recording_processes import (
    HEARTBEAT,
    SYNC_S,
    acquire,
    bus_at,
    checked,
    drives,
    end,
    folder,
    frames_of,
    port,
    texts,
    tracking,
    wait_for,
)
from test_third_party import THIRD_PARTY_DRIVE, node, npm

from acquisition.master.master import Master
from acquisition.protocol.states import State, state_of
from acquisition.recorder.dead_man import DeadMan, SignsOfLife, silence_s
from acquisition.recording.reader import Recording
from acquisition.transport.link import open_link

__all__ = ["folder", "npm", "port"]  # fixtures
LONGEST_S = 0.4  # from the last SYNC of the session to the quick stop of every drive


@contextmanager
def stalls() -> Iterator[list[float]]:
    """How late this machine wakes a process that sleeps 5 ms, at worst: [seconds]."""
    worst, over = [0.0], threading.Event()

    def sleep() -> None:
        while not over.is_set():
            began = time.monotonic()
            time.sleep(0.005)
            worst[0] = max(worst[0], time.monotonic() - began - 0.005)

    thread = threading.Thread(target=sleep)
    thread.start()
    try:
        yield worst
    finally:
        over.set()
        thread.join()


def states(recording: Recording, number: int) -> list[tuple[int, State]]:
    """Time and state of every PDO of a drive."""
    frames = frames_of(recording)
    own = frames[frames["can_id"] == 0x180 + number]
    words = own["data"][:, :2].copy().view("<u2")[:, 0]
    return [(int(t), state_of(int(word))) for t, word in zip(own["time_ns"], words, strict=True)]


def stopped_s(recording: Recording, number: int, since_ns: int) -> float:
    """From `since_ns` to the first PDO of a drive that is not enabled any more."""
    then = [t for t, state in states(recording, number) if t > since_ns and state is not State.OPERATION_ENABLED]
    return (then[0] - since_ns) * 1e-9


def last_target_ns(recording: Recording) -> int:
    """When the session commanded drives for the last time, before the first quick stop."""
    frames = frames_of(recording)
    targets = frames[(frames["can_id"] == 0x201) & (frames["data"][:, 0] == 0x0F)]
    return int(targets["time_ns"][-1])


def disabled_by_the_recorder(recording: Recording) -> bool:
    """ShowStatus, and the drives' own last words on the disk too."""
    confirmed = "every drive confirmed to the recorder's process" in texts(recording, "disabled")
    return confirmed and all(states(recording, k)[-1][1] is State.SWITCH_ON_DISABLED for k in (1, 2))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_drives_without_supervision_of_their_own_are_stopped(folder, number):
    out = folder / "log.mcap"
    with drives(folder, "--unsupervised"), stalls() as worst:
        with tracking(folder, out, "--unsupervised-drives") as session:
            session.send_signal(number)
            try:
                recording = wait_for(out, disabled_by_the_recorder)
            finally:
                session.send_signal(signal.SIGCONT)
            last_ns = last_target_ns(recording)
            for node_id in (1, 2):
                assert stopped_s(recording, node_id, last_ns) < LONGEST_S + 2 * worst[0]
            _, errors = session.communicate(timeout=60)
            assert session.returncode != 0
            if number is signal.SIGSTOP:
                assert "fault" in errors
        recording = wait_for(out, lambda r: not r.cut)
        assert last_target_ns(recording) == last_ns  # who wakes up enables nothing
        assert {state for t, state in states(recording, 1) if t > last_ns + 10**9} <= {State.SWITCH_ON_DISABLED}
        assert "1, 2  switch on disabled" in checked(folder)
    silent = (
        "the session's process is gone" if number is signal.SIGKILL else "no sign of life from the session for 0.3 s"
    )
    assert f"{silent}: the recorder's process stopped the drives" in texts(recording, "fault")
    assert len(recording.samples) > 0


def test_drives_left_enabled_are_disabled_by_command(folder):
    with drives(folder, "--unsupervised"):
        link = open_link(bus_at(folder), passive=False)
        robot = robot_of((folder / "robot.toml").read_text())
        master = Master(link, bus_of(robot))
        try:
            master.configure()
            master.start()
            for node_id in (1, 2):
                for word in (6, 7, 15):
                    master.write(node_id, 0x6040, 0, word, 2)
            master.sync()
            master.wait(link.now_ns() + 1_000_000_000, for_answers=True)
            assert [master.state(drive) for drive in master.bus.drives] == [State.OPERATION_ENABLED] * 2
            done = acquire(folder, "disable", str(folder / "robot.toml"))
            output, errors = done.communicate(timeout=60)
            assert (done.returncode, errors) == (0, "")
            assert output == "disabled: nodes 1, 2; all in pre-operational\n"
            master.wait(link.now_ns() + 200_000_000)  # answers to the command's own questions
            assert [master.state(drive) for drive in master.bus.drives] == [State.SWITCH_ON_DISABLED] * 2
            link.send(0x201, struct.pack("<Hi", 6, 0))  # a PDO commands nothing any more
            master.sync()
            master.wait(link.now_ns() + 100_000_000)
            assert master.state(master.bus.drives[0]) is State.SWITCH_ON_DISABLED
        finally:
            link.close()


def test_disable_says_first_who_did_not_confirm(folder):
    done = acquire(folder, "disable", str(folder / "robot.toml"))
    output, errors = done.communicate(timeout=60)
    assert (done.returncode, output) == (1, "")
    assert errors == "NOT DISABLED: nodes 1, 2: EMERGENCY STOP\n"
    (folder / "away.toml").write_text((folder / "robot.toml").read_text().replace("udp_multicast", "socketcan"))
    done = acquire(folder, "disable", str(folder / "away.toml"))
    _, errors = done.communicate(timeout=60)
    assert done.returncode == 1
    assert errors.splitlines()[0] == "NOT DISABLED: nodes 1, 2: EMERGENCY STOP"
    assert "cannot be opened" in errors.splitlines()[1]


def test_a_dead_man_acts_only_when_armed_and_not_ended():
    bus = bus_of(robot_of(bus_text(2, channel="nobody_here")))
    for signs, acts in (("", False), ("a", True), ("aae", False), ("aea", True)):
        here, there = multiprocessing.Pipe()
        dead_man, life = DeadMan(here, bus), SignsOfLife(there)
        for sign in signs:
            life.alive() if sign == "a" else life.ended()
        life.close()
        dead_man._thread.join(20)
        assert not dead_man.waiting
        assert (dead_man.reason is not None) == acts
        kinds = [kind for _, kind, _ in dead_man.events]
        assert kinds == (["fault", "not disabled"] if acts else [])


def test_signs_never_wait_for_a_recorder_that_hangs():
    here, there = multiprocessing.Pipe()
    life = SignsOfLife(there)
    began = time.monotonic()
    for _ in range(300_000):
        life.alive()
    assert time.monotonic() - began < 30.0
    here.close()
    life.alive()
    life.close()


def test_silence_is_longer_than_a_few_periods():
    assert silence_s(bus_of(robot_of(bus_text(2))).file) == 0.3
    assert silence_s(bus_of(robot_of(bus_text(2, period_s=0.2))).file) == pytest.approx(0.6)


def test_a_third_party_drive_is_stopped(folder, npm):
    """It knows no quick stop and goes on moving, so voltage goes off; it says so itself."""
    if not THIRD_PARTY_DRIVE.exists():
        pytest.skip("the third-party drive is not here: ../shared/tools/third_party_drive.js")
    group, _, number = bus_at(folder).channel.partition(":")
    rpdo = 'rpdo = [{ objects = ["6040", "6060"] }]'
    text = bus_text(
        1, period_s=SYNC_S, interface="udp_multicast", channel=f"{group}:{number}", extra=HEARTBEAT, drive=rpdo
    )
    bus = bus_of(robot_of(text.replace("node = 1\n", "node = 7\n")))
    process = node(npm, THIRD_PARTY_DRIVE, "7", group, number, "120")
    link = open_link(bus.file, passive=False)
    try:
        assert process.stderr is not None
        assert "node 7" in process.stderr.readline()
        master = Master(link, bus)
        master.nmt(1, 7)
        for word in (6, 7, 15):
            link.send(0x207, struct.pack("<Hb", word, 8))
            master.sync()
            master.wait(link.now_ns() + 100_000_000, for_answers=True)
        master.sync()
        master.wait(link.now_ns() + 500_000_000, for_answers=True)
        assert master.nodes[0].state is State.OPERATION_ENABLED
        here, there = multiprocessing.Pipe()
        dead_man, life = DeadMan(here, bus), SignsOfLife(there)
        life.alive()
        life.close()  # as when the session is killed
        words = []
        until_ns = link.now_ns() + 20 * 10**9
        while dead_man.waiting and link.now_ns() < until_ns:
            frame = link.receive(link.now_ns() + 50_000_000)
            if frame is not None:
                master.dispatch(frame)
                words += [frame.data[:2]] if frame.can_id == 0x207 else []
        assert words[0] == b"\x02\x00"
        assert b"\x00\x00" in words
        assert [kind for _, kind, _ in dead_man.events] == ["fault", "disabled"]
        assert master.state(bus.drives[0]) is State.SWITCH_ON_DISABLED
    finally:
        link.close()
        end(process, signal.SIGTERM)
