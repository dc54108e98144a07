"""Speed and memory of the import of a candump.

Run with `pytest tests/benchmarks -s --benchmark-enable`; CANDUMP_MB=1000 for the size that the
bounds are for, which takes a minute. The figures stand in acquire_speed.md.
"""

import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from made_up_buses import bus_text

MEGABYTES = int(os.environ.get("CANDUMP_MB", "50"))
DRIVES, PERIOD_US, AT_ONCE = 6, 2000, 20_000
MAX_ANONYMOUS_BYTES = 600e6
# of the CPU time by which python-can's reader alone gives the frames one by one
MAX_CPU_RATIO = 1.3
DIGITS = np.frombuffer(b"0123456789ABCDEF", np.uint8)
RIVAL = "import can, sys\nfor message in can.LogReader(sys.argv[1]): pass"
IMPORT = "import sys; from acquisition.commands import main; sys.exit(main(sys.argv[1:]))"


def lines(can_id: int, time_us: np.ndarray, data: np.ndarray) -> np.ndarray:
    """Lines of candump (n, length), as bytes, of frames with one identifier."""
    head = np.frombuffer(f"(0000000000.000000) can0 {can_id:03X}#".encode(), np.uint8)
    text = np.full((len(data), len(head) + 2 * data.shape[1] + 1), ord("\n"), np.uint8)
    text[:, : len(head)] = head
    for place, column in enumerate([17, 16, 15, 14, 13, 12, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1]):
        text[:, column] = DIGITS[time_us // 10**place % 10]
    text[:, len(head) : -1 : 2], text[:, len(head) + 1 : -1 : 2] = (
        DIGITS[data >> 4],
        DIGITS[data % 16],
    )
    return text


def candump(path: Path, megabytes: int) -> int:
    """Write SYNC every 2 ms and the answers of six drives that swing; the number of frames."""
    syncs = 0
    with path.open("wb") as file:
        while file.tell() < megabytes * 10**6:
            k = syncs + np.arange(AT_ONCE)
            time_us = 1_700_000_000_000_000 + k * PERIOD_US
            parts = [lines(0x80, time_us, np.zeros((AT_ONCE, 0), np.uint8))]
            for i in range(DRIVES):
                pdo = np.zeros(AT_ONCE, [("status", "<u2"), ("position", "<i4"), ("effort", "<i2")])
                phase = 2 * np.pi * (0.5 + 0.2 * i) * k * PERIOD_US * 1e-6
                pdo["status"], pdo["position"] = 0x1237, np.rint(20_000 * np.sin(phase))
                pdo["effort"] = np.rint(300 * np.cos(phase))
                data = pdo.view(np.uint8).reshape(AT_ONCE, 8)
                parts.append(lines(0x181 + i, time_us + 150 * (i + 1) + k % 7, data))
            np.concatenate(parts, axis=1).tofile(file)
            syncs += AT_ONCE
    return syncs * (1 + DRIVES)


def run(code: str, *arguments: object) -> tuple[float, float]:
    """CPU seconds of Python code as a process, and its most anonymous memory in bytes."""
    before, most = resource.getrusage(resource.RUSAGE_CHILDREN), 0
    process = subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)])
    status = Path(f"/proc/{process.pid}/status")
    while process.poll() is None:
        sizes = [x.split()[1] for x in status.read_text().splitlines() if x.startswith("RssAnon")]
        most = max([most, *(1024 * int(size) for size in sizes)])
        time.sleep(0.005)
    assert process.returncode == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, most


def test_candump_import(tmp_path):
    path, robot, out = tmp_path / "large.log", tmp_path / "robot.toml", tmp_path / "a.mcap"
    frames = candump(path, MEGABYTES)
    robot.write_text(bus_text(DRIVES, channel="can0"))
    rival_s, _ = run(RIVAL, path)
    cpu_s, most = run(IMPORT, "import", path, "--robot", robot, "-o", out)
    print(f"\n{path.stat().st_size / 1e6:.0f} MB of candump, {frames / 1e6:.1f} million frames:")
    print(f"{1e6 * cpu_s / frames:.2f} µs of CPU a frame for the whole import, ", end="")
    print(f"{cpu_s / rival_s:.2f} x python-can's reader alone (bound {MAX_CPU_RATIO:g}); ", end="")
    print(f"anonymous memory {most / 1e6:.0f} MB (bound {MAX_ANONYMOUS_BYTES / 1e6:.0f})")
    assert most < MAX_ANONYMOUS_BYTES
    assert cpu_s < MAX_CPU_RATIO * rival_s
