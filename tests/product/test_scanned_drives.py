"""From a scan of drives to a description that records: the units are those of the objects that
the drives have.
"""

import re
import tomllib
from pathlib import Path

import pytest
from command_runs import refused, run
from conftest import ACQUIRE
from dry_sessions import FaultyDrives, connected
from made_up_buses import bus_text, robot_of
from urdfs import urdf
from virtual_buses import bus_file

from acquisition.bus import Uploads, scan_nodes
from acquisition.commands.scanning import ARRAYS, OBJECTS, bus_lines
from acquisition.recording import read_recording
from acquisition.robot import load_robot, resolve

EFFORTS = (0x6074, 0x6077, 0x6078, 0x30D0, 0x2031, 0x221E)


def bus_of_scan(*objects: tuple[int, ...]) -> str:
    """What a scan writes of drives that have these objects of all EFFORTS, 0.42 N m and 1.25 A."""
    link = connected(robot_of(bus_text(len(objects))), FaultyDrives)[0]
    for node, own in zip(link.drives.nodes, objects, strict=True):
        node.values[0x6075, 0] = 1250
        for index in EFFORTS:
            node.types.setdefault((index, 0), "I32" if index == 0x30D0 else "I16")
            node.values[index, 0] = 0
            if index not in own:
                del node.values[index, 0]
    nodes = scan_nodes(Uploads(link, bus_file()), OBJECTS, ARRAYS)
    return "\n".join(bus_lines(bus_file(), nodes)) + "\n"


@pytest.mark.parametrize(
    ("objects", "unit", "scale"),
    [
        # the unit and the scale of one raw integer by CiA 402, and by the makers' manuals
        ((0x6074,), "N m", 0.42e-3),
        ((0x6074, 0x6077, 0x6078), "N m", 0.42e-3),
        ((0x6077,), "N m", 0.42e-3),
        ((0x6077, 0x6078), "N m", 0.42e-3),
        ((0x6078,), "A", 1.25e-3),
        ((0x30D0, 0x6078), "A", 1e-3),
        ((0x2031,), "A", 1e-3),
        ((0x221E, 0x6078), "A", 1e-2),
    ],
)
@pytest.mark.parametrize("way", ["--dh R", "arm.urdf --joints turn", "arm.urdf --joints slide"])
def test_motors_have_unit_of_scanned_object(
    tmp_path, monkeypatch, capsys, objects, unit, scale, way
):
    """Nothing is changed in the description but the lines with FILL IN."""
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(urdf())
    Path("bus.toml").write_text(bus_of_scan(objects))
    init = ["init", *way.split(), "--bandwidth-hz", "5", "--bus", "bus.toml", "-o", "robot.toml"]
    init.append("--overwrite")
    assert run(capsys, *init)[0] == 0
    (motor,) = tomllib.loads(Path("robot.toml").read_text())["motor"]
    assert motor == {"name": "motor_1", "effort_unit": unit}
    filled = re.sub("# ratio = ...", "ratio = 50", Path("robot.toml").read_text())
    Path("robot.toml").write_text(filled.replace("FILL IN", "filled in"))
    (drive,) = resolve(load_robot("robot.toml"), "robot.toml").drives
    assert drive.effort.scale == pytest.approx(scale, rel=1e-12)
    record = ["record", "robot.toml", "-o", "log.mcap", "--dry-run", "--duration", "0.1"]
    assert ACQUIRE.main(record) == 0, capsys.readouterr().err
    assert len(read_recording("log.mcap").samples) > 10
    # a gain is for amperes
    gain = [*init, "--ratio", "50", "--drive-gain", "0.1"]
    if unit == "A":
        assert run(capsys, *gain)[0] == 0
        (motor,) = tomllib.loads(Path("robot.toml").read_text())["motor"]
        torque = "N" if "slide" in way else "N m"
        assert (motor["drive_gain"], motor["drive_gain_unit"]) == (0.1, f"{torque}/A")
        if "slide" in way:  # a linear motor
            linear = Path("robot.toml").read_text().replace("counts_per_turn", "counts_per_m")
            Path("robot.toml").write_text(linear)
        assert resolve(load_robot("robot.toml"), "robot.toml").drives[0].effort.scale == scale
    else:
        assert "--drive-gain = (0.1,): requires efforts in A or % or V" in refused(capsys, *gain)


def test_unit_against_drives_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bus.toml").write_text(bus_of_scan((0x6074,), (0x6078,)))
    both = ["init", "--dh", "RR", "--bus", "bus.toml", "-o", "robot.toml"]
    for effort in ("A", "N m", "%"):
        said = refused(capsys, *both, "--effort", effort)
        assert "the drives in bus.toml report N m, A. Omit --effort." in said
    # of motors of both kinds the gain has to be known
    assert run(capsys, *both, "--ratio", "50", "--drive-gain", "0.1")[0] == 0
    motors = tomllib.loads(Path("robot.toml").read_text())["motor"]
    assert [m.get("effort_unit", m.get("drive_gain_unit")) for m in motors] == ["N m", "N m/A"]
    # a rule by hand counts more than the usual one, and nothing is known without an object
    text = Path("bus.toml").read_text()
    for change, unit in (
        (('actual = "6078"', 'actual = "6078"\nactual_rule = "mN m"'), "N m"),
        (('actual = "6078"', '# reference = "..." # FILL IN'), "N m"),
        (('actual = "6078"', 'reference = "2111:3"\nreference_rule = "mV"'), "V"),
        (('reference = "6074"', 'reference = "30d0:0"'), "A"),
    ):
        Path("bus.toml").write_text(text.replace(*change))
        command = [*both, "--overwrite", "--ratio", "50"]
        command += ["--drive-gain", "0.1"] if unit != "N m" else []
        status, _, err = run(capsys, *command)
        assert status == 0, err
        motors = tomllib.loads(Path("robot.toml").read_text())["motor"]
        found = [m.get("effort_unit", m.get("drive_gain_unit", "")) for m in motors]
        assert unit in found[change[0].startswith("actual")]
    for broken, said in (
        ("[bus]\ndrive = 3\n", "bus.drive = 3: expected a list"),
        ("[bus\n", "this is not valid TOML"),
        ("name = 'x'\n", "top level: a key is missing: `bus`"),
    ):
        Path("bus.toml").write_text(broken)
        assert f"bus.toml: {said}" in refused(capsys, *both, "--overwrite")
