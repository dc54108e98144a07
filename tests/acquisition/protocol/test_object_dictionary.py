"""Object dictionaries: a small EDS typed by hand (CiA 306), real ones, PDOs as they
map them, damaged ones.
"""

import re

import pytest
from conftest import DATA, needs_data
from made_up_buses import bus_of, bus_text, refused, robot_of
from made_up_dictionaries import DEVICE, EDS, SENT_OBJECTS, dictionary_and_text, found

from acquisition.errors import BadInputError
from acquisition.protocol import Confirmed, load_dictionary
from acquisition.robot import load_robot, resolve
from acquisition.simulated import SimulatedDrives

REAL = sorted(path.name for path in (DATA / "eds").glob("*")) or ["(none)"]


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
        # 1018h itself before [DeviceInfo]
        (DEVICE + EDS, [(1, "vendor", 0x9A), (2, "product", 0x777)]),
        (EDS.replace("0x777", "0"), []),
        (DEVICE + EDS.replace("0x777", "0"), [(1, "vendor", 0x9A), (2, "product", 0x30924)]),
        (DEVICE + EDS.replace("[1018", "[1019"), []),  # a drive without 1018h cannot be asked
    ],
)
def test_identities(text, expected):
    assert found(text).identity == expected


def test_dictionary_size_limit():
    remark = ";" + "x" * (4 * 2**20 - len(EDS) - 1)
    assert len(found(EDS + remark).entries) == 14
    with pytest.raises(
        BadInputError,
        match=re.escape("a.eds: the file has 4194305 bytes: expected at most 4194304"),
    ):
        found(EDS + remark + "x")


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("40 76 60 00 00 00 00 00", "43 76 60 00 2C 01 00 00"),  # 300 mN m, as the description says
        ("40 18 10 01 00 00 00 00", "43 18 10 01 9A 00 00 00"),  # out of [DeviceInfo]
        # switched off until a master says otherwise
        ("40 00 18 01 00 00 00 00", "43 00 18 01 85 01 00 80"),
        ("40 08 10 00 00 00 00 00", "80 08 10 00 00 00 02 06"),
        ("2B 41 60 00 01 00 00 00", "80 41 60 00 02 00 01 06"),  # read only
        ("23 76 60 00 01 00 00 00", "60 76 60 00 00 00 00 00"),
    ],
)
def test_simulated_drive_serves_dictionary(asked, answer):
    keys = 'dictionary = "a.eds"\nobjects = { "6040" = "U16", "607A" = "I32" }\nreference = "6074"'
    text = (
        bus_text(1)
        .replace("node = 1\n", "node = 5\n")
        .replace('reference = "6074"', keys)
        .replace("0.42", "0.3")
    )
    robot = robot_of(text, {"dictionary:a.eds": (DEVICE + EDS).encode()})
    (drive,) = SimulatedDrives(robot, bus_of(robot)).nodes
    assert drive.receive(0x605, bytes.fromhex(asked)) == [(0x585, bytes.fromhex(answer))]


def test_empty_number_is_0_with_warning():
    """Makers leave them empty; what says nothing of the identity is not compared with the drive.
    Other numbers of [DeviceInfo] are not needed.
    """
    device = (
        "[DeviceInfo]\r\nVendorName=\r\nVendorNumber=\r\nProductName=\r\nProductNumber= ; "
        "later\r\nNrOfRXPDO = \r\n"
    )
    dictionary = found(
        device + "BaudRate_1000=1\nGranularity=\n" + EDS.replace("DefaultValue=0x777", "")
    )
    assert (dictionary.vendor, dictionary.product, dictionary.identity) == (0, 0, [])
    assert dictionary.warnings == tuple(
        f"a.eds: line {line}: {key} is empty: it is read as 0, and not checked"
        for line, key in (
            (3, "VendorNumber"),
            (5, "ProductNumber"),
        )
    )
    assert found(DEVICE + EDS).warnings == ()


@pytest.mark.parametrize("name", REAL)
def test_real_dictionaries_load_or_give_one_line(name):
    data = (needs_data("eds") / name).read_bytes()
    if name.startswith("infranor"):
        with pytest.raises(
            BadInputError, match=r"line 2112: .MANUFACTUREROBJECTS. contains '12' twice"
        ):
            load_dictionary(data, name, 1)
        return
    found = load_dictionary(data, name, 5)
    kinds = [found.entries[key].type for key in ((0x6041, 0), (0x6064, 0), (0x1800, 1))]
    assert kinds == ["U16", "I32", "U32"]
    assert found.vendor in (0xFB, 0x9A, 0x26C, 0x1A3)


def test_object_missing_in_dictionary():
    data = (needs_data("eds") / "maxon_EPOS4.eds").read_bytes()
    text = bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "a.eds"\n')
    refused(text, "reference = '6074': a.eds does not contain it", {"dictionary:a.eds": data})
    # a U32 there, and no current reference
    text = text.replace('reference = "6074"', 'reference = "2031"')
    nanotec = (needs_data("eds") / "nanotec_CL4-E-2-12.eds").read_bytes()
    refused(
        text, "reference_rule is missing: the unit of 2031:0 (U32)", {"dictionary:a.eds": nanotec}
    )


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        (
            {0x1A00: [4, *SENT_OBJECTS[1:], 0x60410010]},
            "tpdo 1 (mapping = 'dictionary'): the PDO has 10 bytes: expected at most 8",
        ),
        (
            {0x1400: [1, 0x20000201]},
            "rpdo 1 (mapping = 'dictionary'): the identifier 0x20000201 belongs to another",
        ),
        (
            {0x1400: [1, 0x181]},
            "rpdo 1 (mapping = 'dictionary'): the identifier 0x181 is also that of a PDO of",
        ),
        ({0x1800: [1, 0]}, "no PDO from the drive carries 6064:0"),
    ],
)
def test_dictionary_pdos_are_checked(records, expected):
    text, files = dictionary_and_text(records)
    refused(text, expected, files)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "the file contains no objects"),
        (b"\xff\xfe\x00junk", "the file contains no objects"),
        (b"[DeviceInfo]\nVendorNumber=x\n", "the file contains no objects"),
        (b"[6041]\nDataType=6\n DATATYPE = 7\n", "line 3: [6041] contains 'datatype' twice"),
        (b"[6041]\na=1\n[6041]\n", "line 3: [6041] exists twice. Remove one"),
    ],
)
def test_damaged_dictionaries(data, expected):
    with pytest.raises(BadInputError, match=re.escape(f"x.eds: {expected}")):
        load_dictionary(data, "x.eds", 1)


def test_missing_dictionary(tmp_path):
    (tmp_path / "robot.toml").write_text(
        bus_text(1).replace("node = 1\n", 'node = 1\ndictionary = "none.eds"\n')
    )
    with pytest.raises(BadInputError) as caught:
        load_robot(tmp_path / "robot.toml")
    assert (caught.value.key, caught.value.value) == ("bus.drive[0].dictionary", "none.eds")


def test_traffic_pdos_are_checked():
    values = {(0x1800, 1): 0x701, (0x1A00, 0): 3} | {
        (0x1A00, k): SENT_OBJECTS[k] for k in (1, 2, 3)
    }
    robot = robot_of(bus_text(1, drive='mapping = "traffic"'))
    with pytest.raises(
        BadInputError, match=r"tpdo 1 \(mapping = 'traffic'\): the identifier 0x701"
    ):
        resolve(robot, "r.toml", {1: Confirmed(values=values)})
