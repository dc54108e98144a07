"""Captures of EtherCAT: a real one with its master's samples, and made-up ones of what it has not."""

from pathlib import Path

import made_up_ethercat as made_up
import numpy as np
import pytest
from made_up_buses import JOINT, robot_of

from acquisition.importing import import_capture
from acquisition.recording import read_recording
from acquisition.robot import Robot

COUNTS = 524_288
DRIVE = """
[[bus.drive]]
node = {node}
actual = "6077"
rated_torque_nm = 1
counts_per_turn = 524288
"""


def robot_text(n: int = 2, *, drive: str = "", bandwidth_hz: float = 5, period_s: float = 0.001) -> str:
    joints = "".join(JOINT.format(i=i + 1, ratio=1) for i in range(n)).replace("[-150, 150]", "[-36000, 36000]")
    joints = joints.replace("speed_deg_s = 200", "speed_deg_s = 20000")
    bus = f'[bus]\ninterface = "none"\nchannel = "none"\nsync_period_s = {period_s}\n'
    drives = "".join(DRIVE.format(node=i + 1) + drive for i in range(n))
    return f'name = "made up"\n[controller]\nbandwidth_hz = {bandwidth_hz}\n{joints}{bus}{drives}'


ROBOT = robot_of(robot_text())


def imported(tmp_path: Path, content: bytes, robot: Robot = ROBOT, **options):
    """The recording of a capture's bytes, and the summary."""
    path, out = tmp_path / "a.pcap", tmp_path / "a.mcap"
    path.write_bytes(content)
    out.unlink(missing_ok=True)
    found = import_capture(path, out, robot, "robot.toml", **options)
    return read_recording(out), found


def raw(samples: np.ndarray, field: str) -> np.ndarray:
    """Counts, or per mille, (N, n) of samples."""
    scale = 1000.0 if field == "effort" else COUNTS / (2 * np.pi)
    return np.rint(samples[field] * scale).astype(int)


def check(samples: np.ndarray, bus: made_up.Bus, spoilt: set[int] = frozenset()) -> np.ndarray:
    """Every row is the true row of its cycle, by its stamp; the cycles. Those whose own bytes are `spoilt` may differ."""
    cycles = (samples["stamp_ns"] - (made_up.CLOCK_NS if bus.clock == 8 else made_up.BEGIN_NS)) // bus.period_ns
    for i in range(bus.drives):
        for field, true, by in (("position", bus.position, 0), ("effort", bus.effort, 0), ("reference", bus.target, 1)):
            if field in samples.dtype.names:
                wanted = np.array([true(int(k) - by, i) for k in cycles])
                differ = set((cycles[raw(samples, field)[:, i] != wanted] - by).tolist())
                assert differ <= spoilt, (field, sorted(differ - spoilt)[:5])
    return cycles


IMAGES = ["lrd_lwr", "lrw", "overlap", "frames"]


@pytest.mark.parametrize("image", IMAGES)
@pytest.mark.parametrize("wrap", ["", "vlan", "udp"])
def test_rows_are_those_of_their_cycles(tmp_path, image, wrap):
    bus = made_up.Bus(image=image, wrap=wrap, drives=3)
    recording, found = imported(tmp_path, made_up.pcap(bus.packets(300)), robot_of(robot_text(3)))
    cycles = check(recording.samples, bus)
    # The first has no target before; in several frames a row is certain between two regular steps.
    np.testing.assert_array_equal(cycles, np.arange(2, 299) if image == "frames" else np.arange(1, 300))
    assert found.has_reference
    assert found.warnings == ()
    assert "reference" in recording.samples.dtype.names


FILES = [
    *(
        lambda p, order=order, tick=tick: made_up.pcap(p, order=order, tick_ns=tick)
        for order in "<>"
        for tick in (1, 1000)
    ),
    *(
        lambda p, order=order, r=r: made_up.pcapng(p, order=order, resolution=r)
        for order in "<>"
        for r in (None, 9, 0x80 | 20)
    ),
]


@pytest.mark.parametrize("k", range(len(FILES)))
def test_kinds_of_files_give_the_same_samples(tmp_path, k):
    bus = made_up.Bus()
    wanted = imported(tmp_path, made_up.pcap(bus.packets(100)))[0].samples
    found = imported(tmp_path, FILES[k](bus.packets(100)))[0].samples
    for field in ("position", "effort", "reference"):
        np.testing.assert_array_equal(found[field], wanted[field])
    assert (np.diff(found["stamp_ns"]) == bus.period_ns).all()


@pytest.mark.parametrize("transfer", ["expedited", "complete", "segmented", "read"])
def test_the_mapping_is_read_however_it_was_transferred(tmp_path, transfer):
    bus = made_up.Bus(transfer=transfer, couplers=1)
    check(imported(tmp_path, made_up.pcap(bus.packets(100)))[0].samples, bus)
