"""What `robot-acquire check` prints: drives that are alike share a row, differences in words,
the verdict in one line.
"""

import re
from contextlib import closing

import pytest
from dry_sessions import connected
from made_up_buses import bus_of, bus_text, robot_of
from virtual_buses import Ear, served

from acquisition.bus import Master, open_link
from acquisition.commands import checking, main
from acquisition.commands.checking import Finding, check_drives, refusal, table, verdicts
from acquisition.protocol import State, abort_answer, request_of
from acquisition.recording import read_recording
from acquisition.session import InlineLog, Recorder, Stop, Task, run_active
from acquisition.simulated import SimulatedNode


def test_equal_drives_share_row_and_silent_is_named(monkeypatch):
    run, _ = connected(robot_of(bus_text(3)))
    run.drives.nodes[1].values[0x6007, 0] = 0
    lines = table(check_drives(run, run.drives.bus))
    first, second = [line for line in lines if "reaction 6007" in line]
    assert "  1, 3     1: fault when" in first
    assert "  2        0: a lost heartbeat has no effect" in second
    assert sum("605A" in line for line in lines) == 1
    run.drives.silent.add(1)
    findings = check_drives(run, run.drives.bus)
    assert [(f.subject, f.node) for f in findings if not f.ok] == [("state", 2)]
    assert refusal(findings) == "the check failed: state of node 2"
    run.drives.silent |= {0, 1, 2}
    findings = check_drives(run, run.drives.bus)
    monkeypatch.setenv("COLUMNS", "60")
    (row,) = [line for line in table(findings) if "state" in line]
    assert ("1, 2, 3" in row, {len(line) - len(line.lstrip()) for line in row.split("\n")[1:]}) == (
        True,
        {row.index("the")},
    )
    assert refusal(findings).startswith("the check failed: no drive answers. Without hardware,")


def test_findings_for_track_only():
    even = Finding(subject="SYNC", found="", ok=False, track=True)
    drive = Finding(subject="state", found="\x1b[2J\n", ok=False, node=4)
    assert refusal([even]) == "the check for --track failed: SYNC"
    assert refusal([even, drive]) == "the check failed: SYNC, state of node 4"
    assert verdicts([even]) == {"recording": "passed", "motion": "failed: SYNC"}
    assert verdicts([even, drive]) == {
        "recording": "failed: state of node 4",
        "motion": "failed: SYNC, state of node 4",
    }


@pytest.mark.parametrize("state", [*State])
def test_fault_allows_recording_enabled_does_not(tmp_path, state):
    """As `record` does: it moves a drive in fault only after a reset that somebody confirms."""
    run, master = connected()
    run.drives.nodes[1].state = state
    run.drives.nodes[1].tick = lambda: None
    run.drives.nodes[1].values[0x6041, 0] = state.value[1]
    said = verdicts(check_drives(run, master.bus))
    enabled = state in (
        State.OPERATION_ENABLED,
        State.QUICK_STOP_ACTIVE,
        State.FAULT_REACTION_ACTIVE,
    )
    assert said["recording"] == ("failed: state of node 2" if enabled else "passed")
    assert said["motion"] == (
        "failed: state of node 2" if enabled or state is State.FAULT else "passed"
    )


WITHOUT_LIMIT = ("following_error_deg = 5\n", "")
UNCONFIRMED = ("", 'unconfirmed = ["joint_1"]\n')
WITHOUT_CONTROL = ("node = 1", 'rpdo = [{ objects = ["607A"] }]\nnode = 1')


@pytest.mark.parametrize(
    ("change", "recording", "motion"),
    [
        (("", ""), "passed", "passed"),
        (WITHOUT_LIMIT, "passed", "failed: limits"),
        (WITHOUT_CONTROL, "passed", "failed: PDOs"),
        (UNCONFIRMED, "passed", "failed: unconfirmed"),
        (("ratio = 50.0", "ratio = 50.0 # FILL IN"), "passed", "failed: FILL IN"),
        (("ratio = 50.0\n", ""), "passed", "failed: ratio 607D 6080 of node 1"),
        (("node = 1", 'node = 1\nmapping = "traffic"'), "failed: mapping", "failed: PDOs, mapping"),
    ],
)
def test_missing_keys_of_robot_toml(tmp_path, capsys, monkeypatch, change, recording, motion):
    # On a busy machine SYNC is uneven.
    monkeypatch.setattr(checking, "_jitter", lambda master: Finding(subject="SYNC", found=""))
    text, robot = bus_text(1, channel="lacks"), tmp_path / "robot.toml"
    robot.write_text(text.replace(*change, 1))
    with served("lacks", 1):
        assert main(["check", str(robot)]) == (motion != "passed")
    told = capsys.readouterr().out.splitlines()
    assert told[:3] == [f"Check for recording {recording}.", f"Check for motion {motion}.", ""]
    assert ["FAILED" in line for line in told[3:]] == sorted(["FAILED" in x for x in told[3:]])[
        ::-1
    ]


def test_drives_with_sdo_quirks_are_recorded(tmp_path, capsys, monkeypatch):
    """No 1017h and no 60C2h, no sizes, a value behind them that means nothing."""
    own = SimulatedNode._serve

    def serve(node: SimulatedNode, data: bytes) -> bytes:
        asked, answer = request_of(data), own(node, data)
        if asked.index in (0x1017, 0x60C2):
            return abort_answer(asked.index, asked.sub, "object does not exist")
        size = 4 - (answer[0] >> 2 & 3)
        value = b"\x42" + answer[1 : 4 + size] + b"\xa5" * (4 - size)
        return value if answer[0] >> 5 == 2 else answer

    monkeypatch.setattr(SimulatedNode, "_serve", serve)
    path, text = tmp_path / "robot.toml", bus_text(2, channel="otherwise", period_s=0.05)
    path.write_text(text)
    robot = robot_of(text)
    log = InlineLog(Recorder(tmp_path / "log.mcap", robot, source="virtual", place="robot.toml"))
    with served("otherwise", 2):
        ear = Ear("otherwise")
        assert main(["check", str(path)]) == 1
        sent = [frame for frame in ear.frames() if frame.can_id in (0x601, 0x602)]
        with closing(open_link(robot.bus, passive=False, tap=log.tap)) as link:
            task = Task(duration_s=1.0)
            outcome = run_active(robot, Master(link, bus_of(robot)), log, task, Stop())
            log.finish(link.now_ns())
    assert {frame.data[0] for frame in sent} == {0x40}
    out = capsys.readouterr().out
    assert re.search(r"^Check for recording (passed|failed: SYNC)\.$", out, re.MULTILINE)
    refused = "heartbeat 1017 of node 1, interpolation period 60C2 of node 1"
    assert re.search(f"^Check for motion failed: {refused}", out, re.MULTILINE)
    assert outcome.reason == "finished"
    why = "heartbeat 1017: 1017:0: object does not exist (0x06020000)"
    warned = [f"node {k} (motor_{k}): {why}: its heartbeat is not monitored" for k in (1, 2)]
    recording = read_recording(tmp_path / "log.mcap")
    assert [
        event.text
        for event in recording.events
        if event.kind == "warning" and "SYNC paused" not in event.text  # on a busy machine
    ] == warned
    assert len(recording.samples) >= 15
