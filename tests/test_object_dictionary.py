"""A small EDS typed by hand (CiA 306), and what is made of it; what `[bus]` takes at each end of its ranges."""

import re

import pytest
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import AcquisitionError
from acquisition.protocol import ObjectEntry, load_dictionary
from acquisition.robot import parse_homed, resolve
from acquisition.simulated import SimulatedDrives

DEVICE = "[DeviceInfo]\nVendorName=a\nVendorNumber=0x9A\nProductName=gold\nProductNumber=0x30924\n"


def entry_eds(section: str, name: str, kind: str, access: str, *lines: str) -> str:
    text = f"[{section}]\nParameterName={name}\nObjectType=7\nDataType={kind}\nAccessType={access}\n"
    return text + "".join(f"{line}\n" for line in lines)


EDS = (
    entry_eds("1000", "device type", "0x0007", "ro", "DefaultValue=0x00020192")
    + entry_eds("1008", "device name", "0x0009", "const", "DefaultValue=Gold")
    + entry_eds("6041", "statusword", "0x0006", "ro")
    + entry_eds("6060", "mode", "0x0002", "rww", "DefaultValue=8", "ParameterValue=10")
    + entry_eds("6061", "display", "0x0005", "const")
    + entry_eds("6064", "position", "0x0004", "ro")
    + entry_eds("6074", "demand", "0x0003", "ro")
    + entry_eds("6076", "rated torque", "0x0007", "rw", "DefaultValue=420")
    + entry_eds("2000", "a real number", "0x0008", "rw", "DefaultValue=1")
    + "[1018]\nParameterName=identity\nObjectType=9\nSubNumber=3\n"
    + entry_eds("1018sub0", "count", "0x0005", "ro", "DefaultValue=2")
    + entry_eds("1018sub1", "vendor", "0x0007", "ro")
    + entry_eds("1018sub2", "product", "0x0007", "ro", "DefaultValue=0x777")
    + "[1800]\nParameterName=tpdo\nObjectType=9\nSubNumber=2\n"
    + entry_eds("1800sub0", "count", "0x0005", "ro", "DefaultValue=1")
    + entry_eds("1800sub1", "cob", "0x0007", "rw", "DefaultValue=$NODEID+0x180")
)


def found(text: str, node: int = 5):
    return load_dictionary(text.encode(), "a.eds", node)


def test_entries_by_hand():
    entries = found(DEVICE + EDS).entries
    assert {key: (entry.type, entry.writable, entry.value) for key, entry in entries.items()} == {
        (0x1000, 0): ("U32", False, 0x20192),
        (0x1008, 0): ("", False, None),  # a string: no PDO carries it
        (0x6041, 0): ("U16", False, None),
        (0x6060, 0): ("I8", True, 10),  # what the DCF sets comes before the default
        (0x6061, 0): ("U8", False, None),
        (0x6064, 0): ("I32", False, None),
        (0x6074, 0): ("I16", False, None),
        (0x6076, 0): ("U32", True, 420),
        (0x2000, 0): ("", True, None),
        (0x1018, 0): ("U8", False, 2),
        (0x1018, 1): ("U32", False, None),
        (0x1018, 2): ("U32", False, 0x777),
        (0x1800, 0): ("U8", False, 1),
        (0x1800, 1): ("U32", True, 0x185),
    }
    assert found(EDS, 0x7F).entries[0x1800, 1].value == 0x1FF


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (DEVICE + EDS, [(1, "vendor", 0x9A), (2, "product", 0x777)]),  # 1018h itself before [DeviceInfo]
        (EDS, [(2, "product", 0x777)]),
        (EDS.replace("0x777", "0"), []),
        (DEVICE + EDS.replace("0x777", "0"), [(1, "vendor", 0x9A), (2, "product", 0x30924)]),
        (DEVICE + EDS.replace("[1018", "[1019"), []),  # a drive without 1018h cannot be asked
    ],
)
def test_identities(text, expected):
    assert found(text).identity == expected


def test_device_sections():
    with_section, without = found(DEVICE + EDS), found(EDS)
    assert (with_section.vendor, with_section.product) == (0x9A, 0x30924)
    assert (without.vendor, without.product) == (0, 0)


def test_a_dictionary_of_four_mebibytes_and_no_more():
    remark = ";" + "x" * (4 * 2**20 - len(EDS) - 1)
    assert len(found(EDS + remark).entries) == 14
    with pytest.raises(AcquisitionError, match=re.escape("a.eds: 4194305 bytes: expected 4194304 at most")):
        found(EDS + remark + "x")


def test_a_dictionary_that_is_missing_beside_the_description():
    robot = robot_of(bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "a.eds"\n'))
    with pytest.raises(
        AcquisitionError, match=r"bus.drive\[0\].dictionary = 'a.eds': is missing next to the description"
    ):
        resolve(robot, "robot.toml")


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
        ("40 60 60 00 00 00 00 00", "4F 60 60 00 0A 00 00 00"),
        ("40 64 60 00 00 00 00 00", "43 64 60 00 00 00 00 00"),
        ("40 76 60 00 00 00 00 00", "43 76 60 00 2C 01 00 00"),  # 300 mN m, as the description says
        ("40 18 10 01 00 00 00 00", "43 18 10 01 9A 00 00 00"),  # out of [DeviceInfo]
        ("40 18 10 02 00 00 00 00", "43 18 10 02 77 07 00 00"),
        ("40 00 18 01 00 00 00 00", "43 00 18 01 85 01 00 80"),  # switched off until a master says otherwise
        ("40 08 10 00 00 00 00 00", "80 08 10 00 00 00 02 06"),
        ("2B 41 60 00 01 00 00 00", "80 41 60 00 02 00 01 06"),  # read only
        ("23 76 60 00 01 00 00 00", "60 76 60 00 00 00 00 00"),
    ],
)
def test_a_simulated_drive_serves_its_dictionary(asked, answer):
    keys = (
        'dictionary = "a.eds"\nobjects = { "6040" = "U16", "607A" = "I32" }\nreference = "6074"\nrated_torque_nm = 0.3'
    )
    text = bus_text(1).replace("node = 1\n", "node = 5\n").replace('reference = "6074"\nrated_torque_nm = 0.42', keys)
    robot = robot_of(text, {"dictionary:a.eds": (DEVICE + EDS).encode()})
    (drive,) = SimulatedDrives(robot, bus_of(robot)).nodes
    assert drive.receive(0x605, bytes.fromhex(asked)) == [(0x585, bytes.fromhex(answer))]


# [bus]


@pytest.mark.parametrize(
    ("name", "key"), [("6064", (0x6064, 0)), ("60c2:2", (0x60C2, 2)), ("1018:10", (0x1018, 10)), ("2031:255", (0x2031, 255))]
)  # fmt: skip
def test_names_of_objects(name, key):
    """The index is hexadecimal, the sub-index decimal."""
    assert parse_homed(name) == (*key, None)


def test_what_a_description_may_leave_out():
    robot = robot_of(bus_text(1))
    file, drive = robot.bus, robot.bus.drive[0]
    assert (drive.status, drive.control, drive.position, drive.target) == ("6041", "6040", "6064", "607A")
    assert (drive.sign, drive.effort_sign, drive.zero_counts, drive.mapping) == (1, None, 0, "table")
    assert (drive.rated_current_unit, drive.rated_torque_unit) == ("mA", "mN m")
    assert (file.bitrate, file.sync_producer, file.sync_can_id, file.heartbeat_s) == (1_000_000, "recorder", 0x80, 0.1)
    assert file.loopback  # frames stay on this machine
    assert bus_of(robot).period_ns == 2_000_000


@pytest.mark.parametrize("bitrate", [10, 20, 50, 100, 125, 250, 500, 800, 1000])
def test_bit_rates_of_can(bitrate):
    """Those of CiA 301, and 100 kbit/s, which it had before."""
    assert robot_of(bus_text(1, extra=f"bitrate = {bitrate}000")).bus.bitrate == bitrate * 1000


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (("0.002", "0.0001"), None),
        (("0.002", "0.00009"), "bus.sync_period_s = 9e-05: expected 0.0001 to 1"),
        (("0.002", "1.0"), None),
        (("0.002", "1.001"), "bus.sync_period_s = 1.001: expected 0.0001 to 1"),
        (("node = 1\n", "node = 126\n"), None),
        (("node = 1\n", "node = 128\n"), "bus.drive[0].node = 128: expected `int` <= 127"),
        (("node = 1\n", "node = 0\n"), "bus.drive[0].node = 0: expected `int` >= 1"),
        (("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"], number = 512, can_id = 0x300 }]\n'), None),
        (("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"], number = 513, can_id = 0x300 }]\n'), "expected `int` <= 512"),
        (("node = 1\n", 'node = 1\nrpdo = [{ objects = ["6040"], can_id = 0x800 }]\n'), "expected `int` <= 2047"),
        (("node = 1\n", "node = 1\nsign = 0\n"), "bus.drive[0].sign = 0: expected one of"),
        (("node = 1\n", "node = 1\nzero_counts = -2147483648\n"), None),
        (("node = 1\n", "node = 1\nzero_counts = 2147483648\n"), "zero_counts = 2147483648: expected `int` <= 2147483647"),
        (("node = 1\n", 'node = 1\nrated_torque_unit = "Nm"\n'), "rated_torque_unit = 'Nm': expected one of mA, mN m, uN m"),
        (("node = 1\n", 'node = 1\nrated_current_unit = "A"\n'), "rated_current_unit = 'A': expected one of mA, mN m"),
        (("node = 1\n", "node = 1\ncounts_per_m = 5\n"), "expected counts_per_turn or counts_per_m, one of the two"),
        (("node = 1\n", 'node = 1\nposition = "06064"\n'), "bus.drive[0].position = '06064': expected `str` matching"),
        (('channel = "test"', f'channel = "{"x" * 64}"'), None),
        (('channel = "test"', f'channel = "{"x" * 65}"'), "expected `str` of length <= 64"),
        (('channel = "test"', 'channel = "test"\nheartbeat_s = 0.01'), None),
        (('channel = "test"', 'channel = "test"\nheartbeat_s = 0.009'), "bus.heartbeat_s = 0.009: expected `float` >= 0.01"),
    ],
)  # fmt: skip
def test_ends_of_ranges(change, expected):
    text = bus_text(1)
    assert change[0] in text
    if expected is None:
        robot_of(text.replace(*change))
    else:
        with pytest.raises(AcquisitionError) as caught:
            robot_of(text.replace(*change))
        assert expected in str(caught.value)


def test_one_drive_for_each_motor_and_a_node_of_its_own_for_the_master():
    text = bus_text(2)
    with pytest.raises(AcquisitionError, match=r"bus.drive = '1 tables': expected one per motor: 2"):
        robot_of(text[: text.rindex("[[bus.drive]]")])
    with pytest.raises(AcquisitionError, match=r"bus\.master_node = 2: expected a node id that no drive has"):
        robot_of(bus_text(2, extra="master_node = 2"))
    assert robot_of(bus_text(2, extra="master_node = 3")).bus.master_node == 3


def entries(pdo) -> list[str]:
    return [str(entry) for entry in pdo.entries]


def test_what_does_not_fit_one_pdo_goes_into_two():
    """Statusword, position and a reference of 32 bits are 10 bytes."""
    text = bus_text(1).replace('reference = "6074"', 'reference = "30D0"\nobjects = { "30D0" = "I32" }')
    drive = bus_of(robot_of(text.replace('"N m"', '"A"').replace("node = 1\n", "node = 9\n"))).drives[0]
    assert [(pdo.number, pdo.can_id, pdo.length, entries(pdo)) for pdo in drive.tpdos] == [
        (1, 0x189, 6, ["6041:0", "6064:0"]),
        (2, 0x289, 4, ["30D0:0"]),
    ]
    assert drive.carrier(ObjectEntry(index=0x30D0, sub=0, type="I32"), "tpdo") is drive.tpdos[1]
    assert drive.carrier(drive.target, "rpdo") is drive.rpdos[0]
    assert drive.carrier(drive.target, "tpdo") is None


def test_pdos_of_a_description_with_numbers_and_identifiers():
    line = 'tpdo = [{ objects = ["6064", "6074"], number = 3 }, { objects = ["6041"], can_id = 0x6A0, number = 7 }]\n'
    drive = bus_of(robot_of(bus_text(1).replace("node = 1\n", f"node = 1\n{line}"))).drives[0]
    assert [(pdo.number, pdo.can_id, entries(pdo)) for pdo in drive.tpdos] == [
        (3, 0x381, ["6064:0", "6074:0"]),
        (7, 0x6A0, ["6041:0"]),
    ]


def test_the_load_of_a_bus_by_hand():
    """SYNC 55 bits; each drive 135 of its TPDO of 8 bytes and 115 of its RPDO of 6: 555 of 1000 bits in 2 ms."""
    bus = bus_of(robot_of(bus_text(2, extra="bitrate = 500000")))
    assert bus.load == pytest.approx(0.555)


def test_where_efforts_come_from_drive_by_drive():
    bus = bus_of(robot_of(bus_text(3).replace("node = 2\n", "node = 2\nsign = -1\n")))
    told = "object 6074:0 (torque demand, the reference of the current loop (CiA 402)), raw I16 in per mille of rated torque"
    assert bus.provenance == (
        f"motor_1, motor_3: {told} x 0.42 (rated_torque_nm), sign +1; motor_2: {told} x 0.42 (rated_torque_nm), sign -1"
    )


def test_an_empty_number_is_read_as_0_with_a_warning():
    """Makers leave them empty; what says nothing of the identity is not compared with the drive."""
    device = (
        "[DeviceInfo]\r\nVendorName=\r\nVendorNumber=\r\nProductName=\r\nProductNumber= ; later\r\nNrOfRXPDO = \r\n"
    )
    dictionary = found(device + "BaudRate_1000=1\nGranularity=\n" + EDS.replace("DefaultValue=0x777", ""))
    assert (dictionary.vendor, dictionary.product) == (0, 0)
    assert dictionary.identity == []
    assert dictionary.warnings == tuple(
        f"a.eds: line {line}: {key} is empty: read as 0, which is not checked"
        for line, key in ((3, "VendorNumber"), (5, "ProductNumber"), (6, "NrOfRXPDO"), (8, "Granularity"))
    )
    assert len(dictionary.entries) == len(found(DEVICE + EDS).entries)
    assert found(DEVICE + EDS).warnings == ()
