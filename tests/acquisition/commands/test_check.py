"""What `robot-acquire check` prints: drives that are alike share a row, differences in words,
the verdict in one line.
"""

from dry_sessions import connected
from made_up_buses import bus_text, robot_of

from acquisition.commands.checking import Finding, check_drives, refusal, table


def test_drives_that_are_alike_share_a_row_and_one_that_does_not_answer_is_named():
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
    assert refusal(findings) == "no go: state of node 2"
    run.drives.silent |= {0, 1, 2}
    findings = check_drives(run, run.drives.bus)
    (row,) = [line for line in table(findings) if "state" in line]
    assert "1, 2, 3" in row
    assert refusal(findings).startswith("no go: no drive answers; without hardware:")


def test_what_only_track_needs():
    even = Finding(subject="SYNC", found="", ok=False, track=True)
    drive = Finding(subject="state", found="\x1b[2J\n", ok=False, node=4)
    assert refusal([even]) == "no go for --track: SYNC"
    assert refusal([even, drive]) == "no go: SYNC, state of node 4"
