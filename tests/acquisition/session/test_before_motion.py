"""What is asked before anything moves: homed, joint positions agreed, SYNC in step;
and the same path slowly.
"""

import gc
import itertools
import os
import resource
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from conftest import robot_named
from dry_sessions import Answering, connected, dry_session, findings, swing
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import Master, confirm_motion, position_words
from acquisition.commands import main
from acquisition.errors import BadInputError, BusFaultError, RefusedError, RobotIdimError
from acquisition.robot import table_reference
from acquisition.session import (
    Pace,
    Recorder,
    RecordOptions,
    Task,
    UserInterface,
    largest_delay_s,
    real_time_scheduling,
    record,
    refuse_jitter,
    running,
    scheduling_words,
    timing,
)
from acquisition.session.running import _before_motion as before_motion


def test_joint_positions_in_words():
    """65536 counts a turn and a ratio of 50: 409600 counts of node 1 are 6.25 turns of
    the motor, 45 degrees.
    """
    run, master = connected()
    for node, counts in zip(run.drives.nodes, (409_600, -819_200), strict=True):
        node.values[0x6064, 0] = counts
    robot, shown = robot_of(bus_text(2)), list[list[str]]()
    words = confirm_motion(robot, master, lambda words, faults: not shown.append(words))
    assert words == shown[0] == ["joint_1 = 45.00 deg", "joint_2 = -90.00 deg"]
    with pytest.raises(RefusedError) as caught:
        confirm_motion(robot, master, lambda words, faults: False)
    assert caught.value.what == "motion"
    assert position_words(robot_named("emps"), np.array([0.25]))[0].endswith(" = 0.25000 m")


def test_fault_reset_is_asked_with_joint_angles():
    robot, (run, master), shown = (
        robot_of(bus_text(2)),
        connected(robot_of(bus_text(2))),
        list[list[str]](),
    )
    run.drives.nodes[1].emergency(0x8611)
    for _ in range(2):
        run.drives.nodes[1].tick()
    with pytest.raises(RefusedError) as caught:
        confirm_motion(robot, master, lambda *asked: bool(shown.extend(asked)))
    words, faults = shown
    assert faults[0].startswith("in fault: node 2 (motor_2): ")
    assert "error code 603F = 0x8611 (following error)" in faults[0]
    assert caught.value.place == "drives"
    assert faults[0] in caught.value.why
    assert confirm_motion(robot, master, lambda words, faults: True) == words + faults
    assert (
        confirm_motion(robot, master, lambda words, faults: not faults, reset_faults=True)
        == words + faults
    )


@pytest.mark.parametrize(
    ("options", "faults", "moves"),
    [
        (["--yes"], [], True),
        (["--yes"], ["in fault: node 1"], False),
        (["--yes", "--reset-faults"], [], True),
    ],
)
def test_yes_confirms_joint_angles_only(tmp_path, monkeypatch, options, faults, moves):
    (tmp_path / "robot.toml").write_text(bus_text(2))
    asked: list[tuple[RecordOptions, bool]] = []

    def run(robot, place, out, given, operator):
        asked.append((given, operator.confirm(["joint_1 = 0 deg"], faults)))
        raise RobotIdimError("enough")

    monkeypatch.setattr("acquisition.session.record", run)
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    assert (
        main(
            ["record", str(tmp_path / "robot.toml"), "-o", "a.mcap", "--track", "ref.csv", *options]
        )
        == 1
    )
    ((given, answer),) = asked
    assert answer is moves
    assert (given.reset_faults, given.unsupervised_drives) == ("--reset-faults" in options, False)


@pytest.mark.parametrize(
    ("values", "missing", "refused"),
    [
        ({(0x1016, 0): 0}, (), ""),  # 6007h is 1
        ({(0x6007, 0): 0, (0x1016, 0): 0}, (), "a lost master has no effect"),
        ({}, (0x1016, 0x6007), "a lost master has no effect"),
        ({(0x6065, 0): 2**32 - 1}, (), "the following error is not monitored"),
        ({}, (0x6065,), "the following error is not monitored"),
        ({(0x6065, 0): 0}, (), ""),
    ],
)
def test_unmonitored_drives_are_no_go_for_motion(values, missing, refused):
    robot, (run, master) = robot_of(bus_text(2)), connected(robot_of(bus_text(2)))
    node = run.drives.nodes[1]
    node.values = {
        key: value for key, value in (node.values | values).items() if key[0] not in missing
    }
    ready = partial(before_motion, robot, master, confirm=lambda words, faults: True)
    if refused:
        with pytest.raises(RefusedError) as caught:
            ready(RecordOptions())
        assert (caught.value.place, caught.value.key) == ("node 2 (motor_2)", "supervision")
        assert caught.value.why.startswith(refused)
    else:
        ready(RecordOptions())
    assert any(
        mark.startswith("confirmed: joint_1")
        for mark in ready(RecordOptions(unsupervised_drives=True))
    )
    lacks = [f for f in findings(run, master.bus) if not f.ok]
    assert [(f.subject, f.node, f.track) for f in lacks] == (
        [("monitoring", 2, True)] if refused else []
    )


@pytest.mark.parametrize("name", ["6041.8", "2000:1", "6041.15", "2000.3"])
def test_drive_without_homing_blocks_motion(name):
    text = bus_text(2, drive=f'homed = "{name}"')
    run, master = connected(robot_of(text))
    robot = robot_of(text)
    assert confirm_motion(robot, master, lambda words, faults: True)  # a simulated drive is homed
    node = run.drives.nodes[1]
    node.more_status = 0
    node.values |= dict.fromkeys([key for key in node.values if key[0] == 0x2000], 0)
    node.tick()
    with pytest.raises(RefusedError) as caught:
        confirm_motion(robot, master, lambda words, faults: True)
    error = caught.value
    assert (error.place, error.key, error.value) == (
        "node 2 (motor_2)",
        "homed",
        robot.bus.drive[1].homed,
    )


def test_nothing_is_written_before_confirmation(tmp_path):
    def refuse(master):
        raise RobotIdimError("the joint positions were not confirmed")

    session = dry_session(tmp_path / "a.mcap", Task(reference=swing(2), before_motion=refuse))
    assert (session.outcome.fault, session.outcome.reason) == (
        True,
        "the joint positions were not confirmed",
    )
    assert set(session.sent["can_id"].tolist()) == {0x601, 0x602}
    assert set(session.sent["data"][:, 0].tolist()) == {0x40}  # reads
    short = Task(reference=np.zeros((2, 2)), before_motion=lambda _: ["confirmed: all"])
    agreed = dry_session(tmp_path / "b.mcap", short)
    assert agreed.outcome.reason == "finished"
    assert "confirmed: all" in agreed.events("mark")


def test_no_session_without_terminal_or_yes(tmp_path, capsys, monkeypatch):
    (tmp_path / "robot.toml").write_text(bus_text(2, interface="socketcan", channel="none0"))
    (tmp_path / "ref.csv").write_text("time_s,joint_1,joint_2\n0,0,0\n0.1,0,0\n")
    monkeypatch.chdir(tmp_path)
    command = ["record", "robot.toml", "-o", "a.mcap", "--track", "ref.csv"]
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    assert main(command) == 1
    assert (
        "without a terminal, the joint positions cannot be confirmed. Run"
        in capsys.readouterr().err
    )
    assert main([*command, "--yes"]) == 1  # it gets as far as the bus
    assert "none0: the bus cannot be opened" in capsys.readouterr().err
    assert not (tmp_path / "a.mcap").exists()


@pytest.mark.parametrize("way", ["", "--passive", "--dry-run", "--track ref.csv --yes"])
@pytest.mark.parametrize(
    ("out", "told"),
    [
        ("old.mcap", "old.mcap: the file already exists. Choose a new name"),
        ("ref.csv", "ref.csv: the file already exists. Choose a new name"),
        ("robot.toml", "robot.toml: the file already exists. Choose a new name"),
        ("away/a.mcap", "away/a.mcap: the folder does not exist or is read-only. Choose"),
        ("old.mcap/a.mcap", "old.mcap/a.mcap: the folder does not exist or is read-only. Choose"),
    ],
)
def test_invalid_output_is_refused_before_bus_opens(tmp_path, capsys, monkeypatch, way, out, told):
    check_that_nothing_begins(tmp_path, monkeypatch, ["-o", out, *way.split()])
    assert capsys.readouterr().err.startswith(f"robot-acquire: {told}")


@pytest.mark.parametrize("way", ["--yes", "--dry-run", "--yes --payload 2", "--speed 0.5 --yes"])
def test_duration_with_reference_is_refused(tmp_path, capsys, monkeypatch, way):
    """A session of a reference lasts as long as it, on drives and in a dry run."""
    options = ["-o", "a.mcap", "--track", "ref.csv", "--duration", "3", *way.split()]
    check_that_nothing_begins(tmp_path, monkeypatch, options)
    said = capsys.readouterr().err.splitlines()[-1]
    assert said.startswith("robot-acquire: --duration = 3.0: a session with a reference lasts")


def check_that_nothing_begins(folder, monkeypatch, options):
    """`record` with `options` ends with status 1: no bus, process or simulated drive was begun, and
    no file has changed.
    """
    (folder / "robot.toml").write_text(bus_text(2, interface="socketcan", channel="none0"))
    (folder / "ref.csv").write_text("time_s,joint_1,joint_2\n0,0,0\n0.1,0,0\n")
    (folder / "old.mcap").write_bytes(b"old")
    monkeypatch.chdir(folder)
    begun = list[str]()
    for name in ("open_link", "ProcessLog", "Recorder", "driven_plant", "LockStepLink"):
        monkeypatch.setattr(running, name, lambda *_, name=name, **__: begun.append(name))
    before = {path: path.read_bytes() for path in folder.iterdir()}
    assert main(["record", "robot.toml", *options]) == 1
    assert not begun
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_one_of_two_sessions_gets_file_name(tmp_path):
    robot, out = robot_of(bus_text(1)), tmp_path / "a.mcap"
    first = Recorder(out, robot, source="first", place="robot.toml")
    size = out.stat().st_size
    with pytest.raises(BadInputError) as caught:
        Recorder(out, robot, source="second", place="robot.toml")
    assert (caught.value.place, out.stat().st_size) == (str(out), size)
    first.close()


def test_slowed_path(tmp_path):
    """q = 0.3 (1 - cos w t) at 0.2 of its speed takes five times as long."""
    path, t = tmp_path / "ref.csv", np.linspace(0, 2, 401)
    q = 0.3 * (1 - np.cos(np.pi * t))
    np.savetxt(path, np.column_stack([t, q]), delimiter=",", header="time_s,joint_1", comments="")
    robot = robot_of(bus_text(1))
    fast, slow = table_reference(path, robot, 0.002), table_reference(path, robot, 0.002, 0.2)
    assert (len(fast), len(slow)) == (1001, 5001)
    assert (
        np.abs(slow[:, 0] - 0.3 * (1 - np.cos(np.pi * 0.2 * np.arange(5001) * 0.002))).max() < 1e-6
    )
    assert slow[::5] == pytest.approx(fast, abs=1e-12)


REF = Path("ref.csv")


@pytest.mark.parametrize(
    ("options", "place", "expected"),
    [
        *(
            ({"track": REF, "speed": x}, "speed", "greater than 0 and at most 1")
            for x in (0, -0.5, 1.5, np.nan)
        ),
        ({"speed": 0.5}, "speed", ""),
        ({"track": REF, "duration_s": 1.0}, "duration_s", ""),
    ],
)
def test_contradicting_options(tmp_path, options, place, expected):
    out, robot = tmp_path / "a.mcap", robot_of(bus_text(1))
    with pytest.raises(BadInputError) as caught:
        record(robot, "robot.toml", out, RecordOptions(dry_run=True, **options), UserInterface())
    assert (caught.value.place or caught.value.key, caught.value.expected) == (place, expected)
    assert not out.exists()


def test_real_time_settings_are_restored(monkeypatch):
    calls, before = [], os.sched_getscheduler(0)
    monkeypatch.setattr(os, "sched_setscheduler", lambda *arguments: calls.append(arguments))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, resource.RLIM_INFINITY))
    with real_time_scheduling() as granted:
        assert not gc.isenabled()
        # memory is locked only where the limit is unlimited
        assert granted == {"sched_fifo": 1.0, "memory_locked": 0.0}
    assert gc.isenabled()
    assert [policy for _, policy, *_ in calls] == [os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, before]

    def denied(*_):
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", denied)
    with real_time_scheduling() as granted:
        assert granted == {"sched_fifo": 0.0, "memory_locked": 0.0}
        assert "SCHED_FIFO is not permitted" in scheduling_words(granted)


def test_excessive_jitter_is_refused(monkeypatch):
    """Intervals of 5 ± 4 ms by turns have a standard deviation of 4 ms, and
    three of them are 12 ms.
    """
    (run, master), late_ns = (
        connected(robot_of(bus_text(1, period_s=0.005))),
        itertools.cycle((4_000_000, 0)),
    )
    receive = run.receive
    monkeypatch.setattr(run, "receive", lambda until_ns: receive(until_ns + next(late_ns)))
    monkeypatch.setattr(timing, "largest_delay_s", lambda _: 0.0121)
    found = refuse_jitter(master)
    assert (found.sd_s, found.worst_s) == (pytest.approx(0.004, rel=1e-3), pytest.approx(0.004))
    assert found.off == 1.0
    monkeypatch.setattr(timing, "largest_delay_s", lambda _: 0.0119)
    with pytest.raises(
        RefusedError, match=r"SYNC jitter sd = 4.000 ms: 3 standard deviations exceed 11.9 ms"
    ):
        refuse_jitter(master)


def test_jitter_without_foreign_sync():
    run, master = connected(robot_of(bus_text(1, extra='sync_producer = "other"')))
    before_ns = run.now_ns()
    with pytest.raises(BusFaultError) as caught:
        refuse_jitter(master)
    assert (caught.value.place, caught.value.advice) == ("bus", "Start the other SYNC producer")
    assert run.now_ns() - before_ns == 50 * 2_000_000


def test_late_sync_limit_is_3_periods_and_20_ms():
    bus = bus_of(robot_of(bus_text(1, period_s=0.01)))
    assert largest_delay_s(bus.file) == pytest.approx(0.03)
    assert largest_delay_s(bus_of(robot_of(bus_text(1))).file) == 0.02
    assert largest_delay_s(bus_of(robot_of(bus_text(1, extra="late_sync_s = 0.005"))).file) == 0.005
    link = Answering()
    pace = Pace(Master(link, bus))
    pace.start()
    for late_ms in (0, 29):
        link.time_ns = pace.next_ns + late_ms * 1_000_000
        pace.sync(in_motion=True)
    link.time_ns = pace.next_ns + 31_000_000
    with pytest.raises(BusFaultError, match=r"SYNC was 0.031 s late in motion, more than 0.03 s"):
        pace.sync(in_motion=True)
    pace.sync(in_motion=False)
