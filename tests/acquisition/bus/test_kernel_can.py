"""A session over the kernel's own SocketCAN, in User-Mode Linux, so that no module
and no adapter is needed.
"""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from made_up_buses import bus_text

from acquisition.recording import SENT, read_recording

UML = ROOT.parent / "shared" / "tools" / "uml_can.sh"
JOB = """
cd {root}
export PYTHONPATH={root}
touch {folder}/begun
for k in 1 2 3; do
  rm -f {folder}/log.mcap
  {python} {folder}/session.py > {folder}/told.txt 2>&1 && break
done
"""
# The drives in a thread of the session's process: each start of Python takes seconds there.
SESSION = """
import sys, threading
from acquisition.commands import main
from acquisition.robot import load_robot, resolve
from acquisition.simulated import SimulatedDrives, serve
if __name__ == "__main__":
    robot, booted = load_robot("{folder}/robot.toml"), threading.Event()
    drives = SimulatedDrives(robot, resolve(robot, "robot.toml"))
    threading.Thread(target=serve, args=(drives, lambda: False, booted.set), daemon=True).start()
    booted.wait()
    sys.exit(main(["record", "{folder}/robot.toml", "-o", "{folder}/log.mcap", "--duration", "3"]))
"""


def test_session_over_kernel_can(tmp_path: Path) -> None:
    if not UML.exists() or shutil.which("linux.uml") is None:
        pytest.skip(
            "no User-Mode Linux: Debian's user-mode-linux and ../shared/tools/uml_can.sh give a "
            "kernel vcan"
        )
    # One slow processor for master, drives and recorder together: a test of the
    # socket, not of speed.
    text = bus_text(
        2, period_s=0.1, interface="socketcan", channel="vcan0", extra="heartbeat_s = 1.0"
    )
    (tmp_path / "robot.toml").write_text(text)
    job = tmp_path / "job.sh"
    job.write_text(JOB.format(root=ROOT, python=sys.executable, folder=tmp_path))
    (tmp_path / "session.py").write_text(SESSION.format(folder=tmp_path))
    done = subprocess.run(["sh", str(UML), str(job)], capture_output=True, timeout=300, check=False)
    if done.returncode == 99 and not (tmp_path / "begun").exists():
        pytest.skip("User-Mode Linux does not start on this processor: no kernel vcan")
    assert (tmp_path / "told.txt").read_text().endswith("CAN frames; finished\n")
    recording = read_recording(tmp_path / "log.mcap")
    frames = recording.frames["vcan0"]
    syncs = int((frames["can_id"] == 0x80).sum())
    assert 15 <= syncs <= 31  # never faster than asked for; a machine that stalls leaves some out
    for node in (1, 2):
        # the last ones may lack
        assert syncs - 3 <= (frames["can_id"] == 0x180 + node).sum() <= syncs
    sent = frames["can_id"][(frames["flags"] & SENT) != 0]
    assert set(sent.tolist()) == {0, 0x80, 0x601, 0x602}
    assert (np.diff(frames["time_ns"]) >= 0).all()
    assert recording.health[-2].counters["kernel_drops"] == 0
    assert len(recording.samples) >= syncs - 3
    assert recording.health[-1].counters["missing"] == 0
