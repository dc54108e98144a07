"""`[bus]`, object dictionaries, PDOs: resolved, or refused in one line that says what to change."""

import re
from contextlib import suppress

import numpy as np
import pytest
from conftest import DATA, needs_data
from hypothesis import given
from hypothesis import strategies as st
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import AcquisitionError
from acquisition.protocol import (
    ObjectEntry,
    Pdo,
    abort_answer,
    answer_of,
    check_answer,
    configuration,
    frame_bits,
    load_dictionary,
    pdos_of,
    read_request,
    request_of,
    value_answer,
    write_request,
    written_answer,
)
from acquisition.robot import load_robot, refuse_load, refuse_out_of_range, resolve

EDS = sorted(path.name for path in (DATA / "eds").glob("*")) or ["(none)"]


def refused(text: str, expected: str, files: dict[str, bytes] | None = None) -> None:
    with pytest.raises(AcquisitionError, match=re.escape(expected)) as caught:
        bus_of(robot_of(text, files))
    assert "\n" not in str(caught.value)


def test_defaults_are_one_pdo_each_way():
    drive = bus_of(robot_of(bus_text())).drives[1]
    assert [(p.can_id, str([str(e) for e in p.entries]), p.length) for p in (*drive.tpdos, *drive.rpdos)] == [
        (0x182, "['6041:0', '6064:0', '6074:0']", 8),
        (0x202, "['6040:0', '607A:0']", 6),
    ]
    assert drive.effort.scale == pytest.approx(0.42e-3)
    assert drive.rated == {0x6076: 420}
    assert "torque demand" in drive.effort.provenance
    assert "6074:0" in drive.effort.provenance


def test_an_actual_value_that_stands_in_says_so():
    drive = bus_of(robot_of(bus_text().replace("reference =", "actual ="))).drives[0]
    assert "the actual value instead of the reference" in drive.effort.provenance


def test_a_rate_of_six_axes():
    assert bus_of(robot_of(bus_text(6))).load == pytest.approx(0.7775)
    bus = bus_of(robot_of(bus_text(6, period_s=0.001)))  # for a listener, who sends none of it
    expected = "bus.sync_period_s = 0.001: 156% of 1000000 bit/s: expected 95% at most: 0.0016 s"
    with pytest.raises(AcquisitionError, match=re.escape(expected)):
        refuse_load(bus, "robot.toml")
    refuse_load(bus_of(robot_of(bus_text(6))), "robot.toml")
    assert (frame_bits(8), frame_bits(0)) == (135, 55)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("node = 2", "node = 1"), "bus.drive[1].node = 1: expected a node id not used before"),
        (("node = 2", "node = 128"), "bus.drive[1].node = 128: expected `int` <= 127"),
        (("sync_period_s = 0.002", "sync_period_s = 5.0"), "bus.sync_period_s = 5.0: expected 0.0001 to 1"),
        (("sync_period_s = 0.002", "sync_period_s = 0.002\nbitrate = 123"), "bus.bitrate = 123: expected one of 10000"),
        (('reference = "6074"', 'reference = "6074"\nreference_rule = "A"'), "reference_rule = 'A': expected one of per mille"),
        (('reference = "6074"', 'reference = "6074"\nreference_rule = "mA"'), "'mA': gives A: expected N m as motor"),
        (('reference = "6074"', 'reference = "2222"'), "reference = '2222': its type is not known"),
        (('reference = "6074"', 'reference = "2222"\nobjects = { 2222 = "I16" }'), "reference_rule is missing: 2222:0 (I16)"),
        (('reference = "6074"', 'reference = "2222"\nobjects = { 2222 = "F32" }'), "objects[2222] = 'F32': expected one of I8"),
        (('reference = "6074"', ""), "reference is missing: expected the object of the current or torque reference"),
        (("rated_torque_nm = 0.42", ""), "rated_torque_nm is missing: expected the rated value"),
        (("counts_per_turn = 65536", ""), "counts_per_turn is missing: expected counts_per_turn or counts_per_m"),
        (("node = 1\n", 'node = 1\ndictionary = "../x.eds"\n'), "dictionary = '../x.eds': expected the name of a file in"),
        (("node = 1\n", 'node = 1\ntpdo = [{ objects = ["6041", "6064", "606C"] }]\n'), "2 + 4 + 4 = 10 bytes: expected 8"),
        (("node = 1\n", 'node = 1\ntpdo = [{ objects = ["6041", "6064"] }]\n'), "no PDO from the drive carries 6074:0"),
        (("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"], can_id = 0x80 }]\n'), "0x080: expected 0x181 to 0x57F"),
        (("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"], number = 5 }]\n'), "can_id is missing"),
        (("node = 1\n", 'node = 1\nmapping = "dictionary"\n'), "expected a dictionary (EDS or DCF)"),
    ],
)  # fmt: skip
def test_refused_in_one_line(change, expected):
    text = bus_text()
    assert change[0] in text
    refused(text.replace(*change, 1), expected)


OWN = "expected one of its own"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('rpdo = [{ objects = ["6040"], can_id = 0x601 }]', "rpdo 1 (mapping = 'table'): identifier 0x601: expected 0x181"),
        ('rpdo = [{ objects = ["6040"], can_id = 0x701 }]', "identifier 0x701: expected 0x181 to 0x57F"),
        ('rpdo = [{ objects = ["6040"], can_id = 0x182 }]', f"identifier 0x182 is that of a PDO of motor_1: {OWN}"),
        ('tpdo = [{ objects = ["6041", "6064"] }, { objects = ["6074"], number = 1, can_id = 0x281 }]', "is used twice"),
    ],
)  # fmt: skip
def test_pdos_that_would_be_misunderstood(line, expected):
    refused(bus_text().replace("node = 1\n", f"node = 1\n{line}\n"), expected)


@pytest.mark.parametrize(("key", "name"), [("position", "6064"), ("target", "607A")])
@pytest.mark.parametrize("kind", ["I16", "U32"])
def test_positions_of_another_size(key, name, kind):
    text = bus_text().replace("node = 1\n", f'node = 1\nobjects = {{ "{name}" = "{kind}" }}\n')
    refused(text, f"bus.drive[0].{key} = '{name}': is {kind}: expected I32")


def test_targets_beyond_what_the_object_holds():
    robot = robot_of(bus_text(2).replace("node = 2\n", "node = 2\nsign = -1\n"))
    bus = bus_of(robot)
    most = (2**31 - 1) / 65536 / 50 * 2 * np.pi  # of joint 1, at a ratio of 50
    path = np.zeros((5, 2))
    path[3] = most * (1 - 1e-12), most * (1 - 1e-12)
    refuse_out_of_range(path, robot, bus, "x")
    for column, value, told in (
        (0, most * 1.001, "node 1 (motor_1) = 2149631"),
        (1, most * 1.001, "node 2 (motor_2) = -2149631"),
        (0, np.nan, "node 1 (motor_1) = nan counts"),
        (1, 1e308, "node 2 (motor_2) = -inf counts"),
    ):
        path[3] = 0.0
        path[3, column] = value
        with pytest.raises(AcquisitionError, match=re.escape(f"x: at 0.006 s: target of {told}")) as caught:
            refuse_out_of_range(path, robot, bus, "x")
        assert str(caught.value).endswith("counts: expected -2147483648 to 2147483647")


@pytest.mark.parametrize("can_id", ["0x1", "0x81", "0x181", "0x57F", "0x601", "0x701", "0x7FF"])
def test_sync_on_the_identifier_of_another_service(can_id):
    refused(bus_text(extra=f"sync_can_id = {can_id}"), f"bus.sync_can_id = {can_id}: expected 0x80, or 0x680 to 0x6DF")
    assert bus_of(robot_of(bus_text(extra="sync_can_id = 0x6DF"))).file.sync_can_id == 0x6DF


def test_a_robot_without_a_bus_is_told():
    text = bus_text()
    with pytest.raises(AcquisitionError, match=r"r.toml: bus is missing: expected a \[bus\] section"):
        resolve(robot_of(text[: text.index("[bus]")]), "r.toml")


@pytest.mark.parametrize("name", EDS)
def test_every_real_dictionary_loads_or_is_refused_in_one_line(name):
    path = needs_data("eds") / name
    if name.startswith("infranor"):
        with pytest.raises(AcquisitionError, match=r"line 2112: .ManufacturerObjects. holds '12' twice") as caught:
            load_dictionary(path.read_bytes(), name, 1)
        assert "\n" not in str(caught.value)
        return
    found = load_dictionary(path.read_bytes(), name, 5)
    assert found.entries[0x6041, 0].type == "U16"
    assert found.entries[0x6064, 0].type == "I32"
    assert found.vendor in (0xFB, 0x9A, 0x26C, 0x1A3)
    assert found.entries[0x1800, 1].type == "U32"


@pytest.mark.parametrize(
    ("name", "keys", "expected"),
    [
        ("elmo_Gold.dcf", 'reference = "6074"\nrated_torque_nm = 0.42', "6074:0 (torque demand"),
        ("nanotec_CL4-E-2-12.eds", 'reference = "6074"\nrated_torque_nm = 0.42', "6074:0 (torque demand"),
        ("maxon_EPOS4.eds", 'reference = "30D0"', "30D0:0 (current demand value (maxon EPOS4)), raw I32 in mA"),
        ("maxon_EPOS2_347717.eds", 'reference = "2031"', "2031:0 (current demand value (maxon EPOS2)), raw I16 in mA"),
        (
            "ros2_canopen_cia402_slave_fake.eds",
            'actual = "6077"\nactual_rule = "per mille of rated current"\nrated_current_a = 2.0',
            "6077:0 (torque actual value (CiA 402)), the actual value instead of",
        ),
    ],
)
def test_each_vendors_own_reference(name, keys, expected):
    data = (needs_data("eds") / name).read_bytes()
    text = bus_text(1).replace('reference = "6074"\nrated_torque_nm = 0.42', f'dictionary = "{name}"\n{keys}')
    if "2031" in keys or "30D0" in keys or "current" in keys:
        text = text.replace('effort_unit = "N m"', 'effort_unit = "A"')
    drive = bus_of(robot_of(text, {f"dictionary:{name}": data})).drives[0]
    assert expected in drive.effort.provenance
    assert drive.dictionary is not None


def test_an_object_the_dictionary_does_not_hold():
    data = (needs_data("eds") / "maxon_EPOS4.eds").read_bytes()
    text = bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "a.eds"\n')
    refused(text, "reference = '6074': a.eds does not contain it", {"dictionary:a.eds": data})
    text = text.replace('reference = "6074"', 'reference = "2031"')  # a U32 there, and no current reference
    nanotec = (needs_data("eds") / "nanotec_CL4-E-2-12.eds").read_bytes()
    refused(text, "reference_rule is missing: 2031:0 (U32) is not known", {"dictionary:a.eds": nanotec})


def test_mapping_of_a_dcf():
    name = "maxon_EPOS4_Module_50_15_node1.dcf"
    data = (needs_data("eds") / name).read_bytes()
    text = bus_text(1).replace(
        'reference = "6074"\nrated_torque_nm = 0.42',
        f'dictionary = "{name}"\nreference = "30D0"\nmapping = "dictionary"',
    )
    text = text.replace('effort_unit = "N m"', 'effort_unit = "A"')
    with pytest.raises(AcquisitionError, match="no PDO from the drive carries"):
        bus_of(robot_of(text, {f"dictionary:{name}": data}))  # this one maps no current demand
    found = load_dictionary(data, name, 1)
    values = {key: e.value for key, e in found.entries.items() if e.value is not None}
    types = {key: e.type for key, e in found.entries.items()}
    pdos = pdos_of("tpdo", values, types, name)
    assert pdos[0].can_id == 0x181
    assert str(pdos[0].entries[0]) == "6041:0"


MINIMAL_EDS = """
[6040]
ParameterName=controlword
DataType=6
AccessType=rw
[6041]
ParameterName=statusword
DataType=6
AccessType=ro
[6064]
ParameterName=position
DataType=4
AccessType=ro
[6074]
ParameterName=torque demand
DataType=3
AccessType=ro
[607A]
ParameterName=target
DataType=4
AccessType=rw
"""


def record_eds(index: int, values: list[int]) -> str:
    """A parameter record, its sub-indices from 0; the number of mapped objects, or the COB-ID as sub-index 1."""
    text = f"[{index:04X}]\nParameterName=p\nObjectType=9\nSubNumber={len(values)}\n"
    for sub, value in enumerate(values):
        kind = 7 if sub else 5
        text += f"[{index:04X}sub{sub}]\nParameterName=s\nDataType={kind}\nAccessType=rw\nDefaultValue=0x{value:X}\n"
    return text


SENT_OBJECTS = [3, 0x60410010, 0x60640020, 0x60740010]
TAKEN_OBJECTS = [2, 0x60400010, 0x607A0020]


def dictionary_and_text(records: dict[int, list[int]]) -> tuple[str, dict[str, bytes]]:
    """A drive mapped as its dictionary says, and that dictionary."""
    known = {0x1800: [1, 0x181], 0x1A00: SENT_OBJECTS, 0x1400: [1, 0x201], 0x1600: TAKEN_OBJECTS} | records
    eds = MINIMAL_EDS + "".join(record_eds(index, values) for index, values in known.items())
    text = bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "a.dcf"\nmapping = "dictionary"\n')
    return text, {"dictionary:a.dcf": eds.encode()}


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        ({0x1A00: [4, *SENT_OBJECTS[1:], 0x60410010]}, "tpdo 1 (mapping = 'dictionary'): 10 bytes: expected 8 at most"),
        ({0x1400: [1, 0x601]}, "rpdo 1 (mapping = 'dictionary'): identifier 0x601: expected 0x181 to 0x57F"),
        ({0x1400: [1, 0x20000201]}, "rpdo 1 (mapping = 'dictionary'): identifier 0x20000201: expected 0x181 to 0x57F"),
        ({0x1400: [1, 0x181]}, "rpdo 1 (mapping = 'dictionary'): identifier 0x181 is that of a PDO of motor_1"),
        ({0x1800: [1, 0]}, "no PDO from the drive carries 6064:0"),
    ],
)
def test_pdos_of_a_dictionary_are_looked_at_as_those_of_the_file(records, expected):
    text, files = dictionary_and_text(records)
    refused(text, expected, files)


def test_a_pdo_with_the_identifier_0_is_switched_off():
    """Controlwords would go out as commands of network management."""
    drive = bus_of(robot_of(*dictionary_and_text({}))).drives[0]
    assert [pdo.can_id for pdo in drive.rpdos] == [0x201]
    for off in (0, 0x40000000):
        assert bus_of(robot_of(*dictionary_and_text({0x1400: [1, off]}))).drives[0].rpdos == ()


def test_pdos_of_traffic_are_looked_at_too():
    values = {(0x1800, 1): 0x701, (0x1A00, 0): 3} | {(0x1A00, k): SENT_OBJECTS[k] for k in (1, 2, 3)}
    robot = robot_of(bus_text(1, drive='mapping = "traffic"'))
    with pytest.raises(AcquisitionError, match=r"tpdo 1 \(mapping = 'traffic'\): identifier 0x701"):
        resolve(robot, "r.toml", {1: values})


@pytest.mark.parametrize(
    ("kind", "unit", "counts", "expected"),
    [
        ("revolute", '"A"', "counts_per_turn", None),
        ("revolute", '"A"', "counts_per_m", "moves no prismatic joint: expected counts_per_turn"),
        ("prismatic", '"A"', "counts_per_turn", None),  # a spindle
        ("prismatic", '"A"', "counts_per_m", None),
        ("prismatic", '"N"', "counts_per_m", None),
        ("prismatic", '"N"', "counts_per_turn", "gives a force: expected counts_per_m"),
        ("prismatic", '"N m"', "counts_per_m", "gives a torque: expected counts_per_turn"),
    ],
)
def test_counts_per_turn_of_motors_that_turn(kind, unit, counts, expected):
    rule = {'"A"': "mA", '"N"': "mN", '"N m"': "mN m"}[unit]
    text = bus_text(1, drive=f'reference_rule = "{rule}"').replace('effort_unit = "N m"', f"effort_unit = {unit}")
    text = text.replace("counts_per_turn", counts).replace('"revolute"', f'"{kind}"')
    text = "\n".join(line for line in text.split("\n") if kind == "revolute" or "_deg" not in line or "dh" in line)
    if expected is None:
        assert bus_of(robot_of(text)).drives[0].name == "motor_1"
    else:
        refused(text, expected)


def test_damaged_dictionaries(tmp_path):
    for data, expected in (
        (b"", "holds no objects"),
        (b"\xff\xfe\x00junk", "not a readable EDS or DCF"),
        (b"[DeviceInfo]\nVendorNumber=x\n", "not a readable EDS or DCF"),
        (b"[1000]\nObjectType=7\n", "not a readable EDS or DCF"),
        (b"[6041]\na=1\n[6041]\n", "line 3: [6041] is there twice: expected once"),
    ):
        with pytest.raises(AcquisitionError, match=re.escape(f"x.eds: {expected}")) as caught:
            load_dictionary(data, "x.eds", 1)
        assert "\n" not in str(caught.value)
    (tmp_path / "robot.toml").write_text(bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "none.eds"\n'))
    with pytest.raises(AcquisitionError, match=r"bus.drive\[0\].dictionary = 'none.eds': cannot be read: No such file"):
        load_robot(tmp_path / "robot.toml")


@given(st.binary(max_size=300))
def test_any_bytes_as_a_dictionary_are_one_line_or_a_result(data):
    with suppress(AcquisitionError):  # which is one line whatever it is made of
        load_dictionary(b"[DeviceInfo]\n[6041]\nParameterName=x\nDataType=6\nAccessType=ro\n" + data, "x.eds", 1)


def test_configuration_in_the_order_of_cia_301():
    pdo = Pdo(number=2, can_id=0x285, entries=(ObjectEntry(index=0x6064, sub=0, type="I32"),))
    assert list(configuration("tpdo", pdo)) == [
        (0x1801, 1, 0x80000285, 4),
        (0x1801, 2, 1, 1),
        (0x1A01, 0, 0, 1),
        (0x1A01, 1, 0x60640020, 4),
        (0x1A01, 0, 1, 1),
        (0x1801, 1, 0x285, 4),
    ]
    values = {(index, sub): value for index, sub, value, _ in configuration("tpdo", pdo)}
    assert pdos_of("tpdo", values, {(0x6064, 0): "I32"}, "x") == (pdo,)


def test_pdo_there_and_back():
    drive = bus_of(robot_of(bus_text(1))).drives[0]
    values = {(0x6041, 0): 0x1237, (0x6064, 0): -5, (0x6074, 0): -32768}
    assert drive.tpdos[0].unpack(drive.tpdos[0].pack(values)) == values
    with pytest.raises(AcquisitionError, match="PDO 0x181: 7 bytes: expected 8"):
        drive.tpdos[0].unpack(b"1234567")


@given(st.integers(0, 0xFFFF), st.integers(0, 255), st.integers(-(2**31), 2**31 - 1), st.sampled_from([1, 2, 3, 4]))
def test_sdo_there_and_back(index, sub, value, size):
    write = request_of(write_request(index, sub, value, size))
    assert (write.kind, write.index, write.sub, write.number) == ("write", index, sub, value % 2 ** (8 * size))
    answer = answer_of(value_answer(index, sub, value, size))
    assert (answer.kind, answer.index, answer.sub, answer.number) == ("value", index, sub, value % 2 ** (8 * size))
    assert request_of(read_request(index, sub)).kind == "read"
    assert answer_of(written_answer(index, sub)).kind == "written"
    with pytest.raises(AcquisitionError, match=r"node 1: refused by the drive: object does not exist \(0x06020000\)"):
        check_answer(answer_of(abort_answer(index, sub, "object does not exist")), "value", "node 1")


@given(st.binary(max_size=9))
def test_any_bytes_as_sdo(data):
    assert request_of(data).kind in ("read", "write", "abort", "other")
    assert answer_of(data).kind in ("value", "written", "abort", "other")
