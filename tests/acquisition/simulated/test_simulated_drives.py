"""Simulated drives as their master sees them: real dictionaries, mapping by
SDO, loops, quantisation.
"""

import dataclasses
import re

import numpy as np
import pytest
from conftest import needs_data
from dry_sessions import connected, dry_session, enable, findings, swing
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.bus import configure, read_needs
from acquisition.errors import RefusedError
from acquisition.recording import sample_dtype
from acquisition.session import Task
from acquisition.simulated import DrivenPlant, SimulatedDrives, TablePlant, cascaded_loops

DEMAND = 'reference = "6074"\nreference_rule = "per mille of rated torque"\nrated_torque_nm = 0.42'
VENDORS = {  # keys of the drive, and where its effort comes from
    "elmo_Gold.dcf": (DEMAND, "6074:0 (torque demand"),
    "nanotec_CL4-E-2-12.eds": ('reference = "6074"\nrated_torque_nm = 0.42',
                               "6074:0 (torque demand"),
    "maxon_EPOS4.eds": ('reference = "30D0"', "30D0:0 (current demand value (maxon EPOS4)), raw "
                                              "I32 in mA"),
    "maxon_EPOS2_347717.eds": ('reference = "2031"',
                               "2031:0 (current demand value (maxon EPOS2)), raw I16 in mA"),
    "ros2_canopen_cia402_slave_fake.eds":
        ('actual = "6077"\nrated_torque_nm = 0.42',
         "6077:0 (torque actual value (CiA 402)), the actual value instead of"),
}  # fmt: skip


def robot_with(name: str, *, n: int = 2):
    keys, _ = VENDORS[name]
    text = bus_text(n).replace(
        'reference = "6074"\nrated_torque_nm = 0.42', f'dictionary = "{name}"\n{keys}'
    )
    if "rated_torque" not in keys:
        text = text.replace('effort_unit = "N m"', 'drive_gain = 0.05\ndrive_gain_unit = "N m/A"')
    return robot_of(text, {f"dictionary:{name}": (needs_data("eds") / name).read_bytes()})


@pytest.mark.parametrize("name", VENDORS)
def test_vendor_dictionaries_are_tracked(tmp_path, name):
    robot = robot_with(name)
    bus = bus_of(robot)
    task = Task(reference=swing(2, seconds=0.4, amplitude=0.1))
    session = dry_session(tmp_path / "a.mcap", task, robot=robot, bus=bus)
    assert session.outcome.reason == "finished", session.outcome.reason
    drive = bus.drives[0]
    assert VENDORS[name][1] in drive.effort.provenance
    entry = drive.effort.entry
    pdo = drive.carrier(entry, "tpdo")
    data = session.frames[session.frames["can_id"] == pdo.can_id]["data"]
    at = pdo.offset(entry.index, entry.sub)
    raw = data[:, at : at + entry.bits // 8].copy().view(f"<i{entry.bits // 8}")[:, 0]
    assert np.ptp(raw) > 10  # the vendor's own reference object carries the effort
    scale = abs(drive.effort.scale) * float(robot.gain[0]) * 50
    assert np.ptp(session.recording.samples["effort"][:, 0]) == pytest.approx(
        np.ptp(raw) * scale, rel=1e-6
    )
    assert "dictionary:" + name in session.recording.attachments
    assert f"{entry}" in session.recording.metadata["effort_provenance"]


def test_dictionary_warnings_reach_recording(tmp_path):
    name = "maxon_EPOS4.eds"
    robot = robot_with(name)
    label = f"dictionary:{name}"
    emptied = re.sub(rb"(?m)^(ProductNumber=)\S+", rb"\1", robot.files[label])
    robot = dataclasses.replace(robot, files={**robot.files, label: emptied})
    line = robot.files[label][: robot.files[label].index(b"ProductNumber=")].count(b"\n") + 1
    warning = f"{name}: line {line}: ProductNumber is empty: it is read as 0, and not checked"
    session = dry_session(tmp_path / "a.mcap", Task(duration_s=0.2), robot=robot)
    assert list(session.recorded.warnings) == session.events("warning") == [warning]
    run, master = connected(robot)
    found = [(f.subject, f.node, f.ok) for f in findings(run, master.bus) if f.found == warning]
    assert found == [("dictionary", 1, True), ("dictionary", 2, True)]


def test_drive_identity_mismatch_is_reported():
    run, master = connected(robot_with("elmo_Gold.dcf", n=1))
    assert [need.refusal for need in read_needs(master, track=False)] == [""] * 5
    run.drives.nodes[0].values[0x1018, 1] = 0x123
    told = "node 1 (motor_1): vendor 1018:1: 0x123, but its dictionary gives 0x9A"
    with pytest.raises(RefusedError, match=f"^{re.escape(told)}.*`robot-acquire check"):
        read_needs(master, track=False)


def test_drive_reports_units_limits_and_modes():
    """Literal values: 65536 counts per turn, ratio 50, 200 deg/s and +-150 deg at the joint; the
    second counts backwards.
    """
    before, after = bus_text(2).rsplit("65536", 1)
    _, master = connected(robot_of(f"{before}6553.6\nsign = -1\nzero_counts = 100{after}"))

    def stated(node: int, *keys: tuple[int, int]) -> list[int]:
        return [master.read(node, *key) for key in keys]

    limit = round(150 / 360 * 50 * 65536)
    units = [(index, sub) for index in (0x608F, 0x6091, 0x6092) for sub in (1, 2)]
    assert stated(1, *units) == [65536, 1, 1, 1, 65536, 1]
    assert stated(1, (0x607D, 1), (0x607D, 2)) == [2**32 - limit, limit]
    assert stated(1, (0x6502, 0), (0x607F, 0), (0x6080, 0)) == [
        0x80,
        round(200 / 360 * 50 * 65536),
        1667,
    ]
    assert stated(2, *units) == [32768, 5, 1, 1, 32768, 5]
    assert stated(2, (0x607D, 1), (0x607D, 2)) == [2**32 + 100 - 136533, 136633]
    master.nmt(129, 1)  # reset node
    assert stated(1, (0x608F, 1), (0x1018, 0)) == [65536, 4]


def test_table_moves_one_row_per_sync():
    """Each row is 0.01 rad further than the one before."""
    samples = np.zeros(9, sample_dtype(2, reference=False))
    samples["position"] = 0.01 * np.arange(9)[:, None]
    held, robot = [], robot_of(bus_text(2))

    class Table(TablePlant):
        def step(self, effort, brakes, duration_s):
            held.append(brakes.tolist())
            super().step(effort, brakes, duration_s)

    plant = DrivenPlant(plant=Table(samples, 500.0), loops=cascaded_loops(robot, np.ones(2)))
    run, master = connected(robot, SimulatedDrives, mechanism=plant)
    found = []
    configure(master, read_needs(master, track=True), track=True)
    for begin in (master.start, lambda: enable(master), lambda: master.write(1, 0x6040, 0, 2, 2)):
        begin()
        for _ in range(2):
            master.sync()
            master.wait(run.now_ns() + 2_000_000)
            found.append(master.nodes[1].counts)
    assert found == [round(0.01 * k * 50 * 65536 / (2 * np.pi)) for k in range(6)]
    assert held[::2] == [[True, True], [False, False], [True, False]]


@pytest.mark.parametrize(("matrix", "windows"), [("", [2**32 - 1, 91_022]),
                                               ("motor_matrix = [[50, 0], [50, 50]]\n",
                                                [2**32 - 1, 2**32 - 1])])  # fmt: skip
def test_joints_without_following_error_limit(tmp_path, matrix, windows):
    """A motor of such a joint supervises none; that of the other, at 5 degrees and a ratio of
    50: twice 5 * 50 / 360 * 65536 counts.
    """
    text = bus_text(2).replace("following_error_deg = 5\n", "", 1)
    text = matrix + (text.replace("ratio = 50.0\n", "") if matrix else text)
    run, _ = connected(robot_of(text), SimulatedDrives)
    assert [node.values[0x6065, 0] for node in run.drives.nodes] == windows
    done = dry_session(tmp_path / "a.mcap", Task(duration_s=0.1), robot=robot_of(text))
    assert done.outcome.reason == "finished"


def test_boot_up_counts_as_first_heartbeat():
    """CiA 301: a drive whose dictionary asks for heartbeats sends the first one a heartbeat
    time after its boot-up.
    """
    made, _ = connected(robot_of(bus_text(1)), SimulatedDrives)
    made.drives.set_heartbeats(100)
    assert made.drives.boot() == [(0x701, b"\0")]
    sent = [made.drives.advance(at_ms * 1_000_000) for at_ms in (1000, 1099, 1100)]
    assert sent == [[], [], [(0x701, b"\x7f")]]
