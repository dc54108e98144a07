"""Speed and memory of the import of EtherCAT captures.

Run with `pytest tests/benchmarks -s --benchmark-enable`.

The figures stand in acquire_speed.md.
"""

import os
import subprocess
import sys
from pathlib import Path

import made_up_ethercat as made_up
import numpy as np
from ethercat_robots import robot_text

MEGABYTES = int(os.environ.get("CAPTURE_MB", "200"))
CYCLES = 10_000  # of a period of the motion
MAX_BYTES = 0.3e9
# The most memory of a process by the kernel's counter is that of its parent, if the parent
# had more when it began.
RUN = """import sys, time
from acquisition.commands import main
status = main(sys.argv[1:])
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
print(time.process_time(), 1024 * int(peak))
sys.exit(status)
"""


class Periodic(made_up.Bus):
    def position(self, k: int, i: int) -> int:
        return round(100_000 * np.sin(2 * np.pi * (k % CYCLES) / CYCLES + i))


def capture(path: Path, megabytes: int) -> None:
    """Two drives at 1 kHz, LRD and LWR: one period of the motion again and
    again, at later times.
    """
    bus, packets = Periodic(), Periodic().packets(CYCLES)
    start = len(bus.start())
    records = (
        np.frombuffer(b"".join(map(made_up.record, packets[start:])), np.uint8)
        .reshape(2 * CYCLES, -1)
        .copy()
    )
    with path.open("wb") as file:
        file.write(made_up.pcap(packets[:start]))
        while file.tell() < megabytes * 10**6:
            records.tofile(file)
            records[:, :4] = (records[:, :4].copy().view("<u4") + CYCLES // 1000).view(np.uint8)


def test_large_capture_import(tmp_path):
    path, robot = tmp_path / "large.pcap", tmp_path / "robot.toml"
    capture(path, MEGABYTES)
    robot.write_text(robot_text())
    command = [
        sys.executable,
        "-c",
        RUN,
        "import",
        path,
        "--robot",
        robot,
        "-o",
        tmp_path / "a.mcap",
    ]
    text = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout
    print(f"\n{text}", end="")
    *_, cpu_s, peak = (float(word) for word in text.splitlines()[-1].split())
    samples = int(text.split(", ")[1].split()[0])
    rate = 2 * samples / cpu_s
    size = f"{path.stat().st_size / 1e6:.0f} MB"
    print(f"{size}: {rate:.0f} frames per CPU second with frames stored, peak {peak / 1e6:.0f} MB")
    assert peak < MAX_BYTES
    assert rate > 80_000
