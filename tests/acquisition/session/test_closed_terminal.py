"""A terminal that is closed while the robot moves: the session ends in order, or goes on."""

import os
import pty
import signal
import sys
from pathlib import Path

import pytest
import session_processes as processes
from busy_machine import tried_again
from conftest import ROOT
from session_processes import drives, folder, port, syncs_tracked

from acquisition.protocol import State
from acquisition.recording import read_recording

__all__ = ["folder", "port"]  # fixtures


def session_on_a_terminal(folder: Path, out: Path, ignored: bool) -> tuple[int, int]:
    """A session whose terminal is the one of the descriptor that is returned with its process;
    `ignored`: as `nohup` starts it.
    """
    command = [sys.executable, "-m", "acquisition", "record", str(folder / "robot.toml")]
    command += ["-o", str(out), "--yes", "--track", str(folder / "ref.csv")]
    process, terminal = pty.fork()
    if not process:
        os.chdir(ROOT)
        signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
        os.execv(sys.executable, command)
    return process, terminal


@tried_again
@pytest.mark.parametrize("ignored", [False, True])
def test_terminal_closed_in_motion(folder, ignored):
    out = folder / "log.mcap"
    with drives(folder):
        process, terminal = session_on_a_terminal(folder, out, ignored)
        try:
            processes.wait_for(out, lambda r: syncs_tracked(r) >= processes.SEEN_SYNCS)
        finally:
            os.close(terminal)
        _, status = os.waitpid(process, 0)
        assert processes.states_of(folder) == [State.SWITCH_ON_DISABLED] * 2
    recording = read_recording(out)
    assert not recording.cut
    ends = [event.text for event in recording.events if event.kind == "end"]
    disabled = [event.text for event in recording.events if event.kind == "disabled"]
    assert (ends, disabled) == (
        ["finished" if ignored else "stopped by SIGHUP"],
        ["every drive confirmed"],
    )
    assert os.waitstatus_to_exitcode(status) == 1  # what was printed is lost; cut short
