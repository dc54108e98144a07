"""The fit after `record --track`: a process of its own, which changes nothing of the session."""

import os
import shutil
import signal
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
from conftest import REPLAY
from dry_sessions import Fault, FaultyDrives
from made_up_buses import bus_text

from acquisition.commands import main, record
from acquisition.recording import read_recording
from acquisition.session import running

NICE = os.nice  # other tests do without
FAILED = "The fit has ended without a result. To repeat it: robot-identify fit log.mcap"


@pytest.fixture
def program(tmp_path, monkeypatch):
    """Give the function that replaces Python by a shell script, which first copies the recording.

    The command of a dry run ends the session after 0.3 s of simulated time.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "nice", NICE)
    (tmp_path / "robot.toml").write_text(bus_text(1))
    (tmp_path / "ref.csv").write_text("time_s,joint_1\n0,0\n0.3,0\n")

    def replace(script):
        python = tmp_path / "python"
        python.write_text(f'#!/bin/sh\necho "$@" >> asked\ncp log.mcap copy.mcap\n{script}\n')
        python.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(python))

    return replace


def status_of(*options):
    return main(["record", "robot.toml", "--dry-run", "-o", "log.mcap", *options])


TRACK = ("--track", "ref.csv")


@pytest.mark.parametrize(
    ("script", "told"),
    [
        ("exit 0", []),
        ("exit 1", []),  # it has told why
        ("kill -KILL $$", [FAILED]),
        ("exec sleep 60", [FAILED]),
        # Ctrl-C and a closed terminal reach both processes, SIGTERM the session alone.
        ("kill -INT $PPID; kill -INT $$", [FAILED]),
        ("kill -HUP $PPID; kill -HUP $$", [FAILED]),
        ("kill -TERM $PPID; sleep 0.2; exit 0", []),
    ],
)
def test_status_is_that_of_session(script, told, program, monkeypatch, capfd, tmp_path):
    run = subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda *of, timeout, **how: run(*of, timeout=1, **how))
    program(f"echo verdict; nice; {script}")
    assert status_of(*TRACK) == 0
    out, err = capfd.readouterr()
    lines = out.splitlines()
    assert lines[0].startswith("log.mcap: ")
    assert lines[1:3] == ["Least-squares fit of log.mcap (--no-fit leaves it out):", "verdict"]
    assert int(lines[3]) >= 10
    assert err.splitlines() == told
    assert (tmp_path / "asked").read_text() == (
        "-P -m identification fit log.mcap --robot robot.toml --method wls --brief\n"
    )
    # It was complete when the fit began.
    found = read_recording(tmp_path / "copy.mcap")
    assert not found.cut
    assert [e.text for e in found.events if e.kind == "disabled"] == ["every drive confirmed"]


def test_missing_program_changes_nothing(program, monkeypatch, capfd):
    program("")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert status_of(*TRACK) == 0
    assert capfd.readouterr().err.splitlines() == [FAILED]


@pytest.mark.parametrize(
    ("why", "options", "status"),
    [
        ("asked", [*TRACK, "--no-fit"], 0),
        ("at rest", ["--duration", "0.1"], 0),
        ("not installed", TRACK, 0),
        ("interrupted", TRACK, 0),
        ("emergency", TRACK, 1),
        ("silent", TRACK, 1),
    ],
)
def test_no_fit_without_whole_motion(why, options, status, program, monkeypatch, capfd, tmp_path):
    """Nor where a drive has not confirmed that it is disabled."""
    program("exit 0")
    if why in ("emergency", "silent"):
        faults = [Fault(kind=why, node=1, sync=130)]
        monkeypatch.setattr(running, "SimulatedDrives", partial(FaultyDrives, faults=faults))
    elif why == "not installed":
        monkeypatch.setattr(record, "find_spec", lambda name: None)
    elif why == "interrupted":
        (tmp_path / "ref.csv").write_text("time_s,joint_1\n0,0\n2,0\n")
        shown = iter([lambda: None, partial(signal.raise_signal, signal.SIGINT)])
        monkeypatch.setattr(record, "live_line", lambda *_: next(shown, list)() or [])
    assert status_of(*options) == status
    out, err = capfd.readouterr()
    assert err.startswith("NOT DISABLED: nodes 1: EMERGENCY STOP\n") is (why == "silent")
    assert ("stopped by SIGINT" in out) is (why == "interrupted")
    assert not (tmp_path / "asked").exists()


def test_words_after_dry_run(tmp_path, monkeypatch, capfd):
    """By the fit itself, of drives that are simulated without noise."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(REPLAY / "scara" / "robot.toml", "robot.toml")
    t = np.arange(0, 2.001, 0.005)
    q = [0.3 * (1 - np.cos(2 * np.pi * f * t / 2)) for f in (1, 2)]
    rows = np.column_stack([t, *q])
    np.savetxt("ref.csv", rows, delimiter=",", header="time_s,shoulder,elbow", comments="")
    assert status_of(*TRACK) == 0
    out, err = capfd.readouterr()
    assert err == ""
    lines = out.splitlines()
    assert lines[1:3] == [
        "Least-squares fit of log.mcap (--no-fit leaves it out):",
        "SCARA: least squares weighted by joint (WLS)",
    ]
    assert lines[3].startswith("Verdict: ")
    assert lines[-2:] == [
        "  The others     shoulder: viscous friction",
        "To narrow their intervals, estimate the delay first: fit with --method iv.",
    ]
