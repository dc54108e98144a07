"""Numbers, encodings and storage in dictionaries (CiA 306), damaged ones, and the PDOs by them."""

import logging
import re

import pytest
from made_up_buses import bus_of, bus_text, refused, robot_of
from made_up_dictionaries import (
    EDS,
    SENT_OBJECTS,
    TAKEN_OBJECTS,
    dictionary_and_text,
    entry_eds,
    found,
)

from acquisition.errors import BadInputError
from acquisition.protocol import load_dictionary, pdos_of

MAPPED = {(0x1801, 1): 0x40000285, (0x1A01, 0): 3}
MAPPED |= {(0x1A01, 1): 0x60410010, (0x1A01, 2): 0x60C20208, (0x1A01, 3): 0x60640020}
KINDS = {(0x6041, 0): "U16", (0x60C2, 2): "I8", (0x6064, 0): "I32"}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            {(0x1A01, 0): 4, (0x1A01, 4): None},
            "tpdo 2: 1A01:4 is not known. Provide all 4 entries",
        ),
        ({(0x1A01, 2): None}, "tpdo 2: 1A01:2 is not known"),
        ({(0x1A01, 2): "was not seen"}, "tpdo 2: 1A01:2 was not seen"),
        ({(0x1A01, 2): 0x60C20207}, "tpdo 2: 1A01:2 maps 7 bits of 60C2:2"),
    ],
)
def test_unknown_entries_shift_no_object(change, expected):
    values = {key: value for key, value in (MAPPED | change).items() if value is not None}
    with pytest.raises(BadInputError, match=expected):
        pdos_of("tpdo", values, KINDS, "x")
    assert pdos_of("tpdo", values | {(0x1801, 1): 0x80000285}, KINDS, "x") == ()
    for key in ((0x1801, 1), (0x1A01, 0)):  # a PDO of which nobody knows that it is there
        assert pdos_of("tpdo", values | {key: "was not seen"}, KINDS, "x") == ()


NUMBERS = {
    "0x30924": 0x30924,
    "0X1a": 26,
    "001": 1,
    "08": 8,
    "0": 0,
    "4294967295": 0xFFFFFFFF,
    "0x00000000000001": 1,
    " $NODEID + 0x180 ": 0x185,
    "0x180+$NODEID": 0x185,
    "$nodeid+384": 0x185,
    "7 ; in a remark = 8": 7,
    # not read: octal or decimal, and what is none
    "010": None,
    "0x": None,
    "7 // status": None,
    "7;8": None,
    "0x1G": None,
    "1_0": None,
    "7h": None,
    "$NODEID": None,
    "9" * 5000: None,
    "": None,
}


@pytest.mark.parametrize(("text", "number"), NUMBERS.items(), ids=[t[:24] for t in NUMBERS])
def test_dictionary_numbers(text, number):
    entries = found(EDS + entry_eds("1005", "sync", "0x0007", "rw", f"DefaultValue={text}")).entries
    assert entries[0x1005, 0].value == number
    line = EDS.count("\n") + 6
    assert entries[0x1005, 0].problem.startswith(f"a.eds: line {line}: DefaultValue") == (
        number is None
    )
    assert len(entries) == 15


@pytest.mark.parametrize(
    ("remark", "encoding"),
    [("Größe", "cp1252"), ("Größe", "utf-8-sig"), ("Größe", "utf-16"), ("速度", "shift-jis")],
)
def test_dictionary_in_other_encoding(remark, encoding):
    text = EDS.replace("ParameterName=position", f"ParameterName={remark}").replace("\n", "\r\n")
    assert load_dictionary(text.encode(encoding), "a.eds", 5).entries == found(EDS).entries


TPDO = "[1800]\nParameterName=tpdo\nObjectType=9\nSubNumber=2\n"
SAME = {
    "other letters": EDS.replace("[1018sub2]", "[1018SUB2]").replace("DataType", "DATATYPE"),
    "lines that say nothing": EDS.replace("DataType", "read me\n=\n[]\n[\nDataType"),
    "lines before any section": "; a remark\nread me\nLines=1\n" + EDS,
    "spaces": EDS.replace("=", " =\t").replace("\n", " \n  ").replace("]", "] ; a remark"),
    "numbers that no PDO needs": EDS.replace("[1018]", "Factor=x\nLowLimit=y\n[1018]"),
    "a record behind its entries": EDS.replace(TPDO, "") + TPDO,
    "an array with a type behind its entries": EDS.replace(TPDO, "") + TPDO + "DataType=7\n",
    "no compact storage of a variable": EDS.replace("[6076]\n", "[6076]\nCompactSubObj=0\n"),
}


@pytest.mark.parametrize("text", SAME.values(), ids=SAME)
def test_dictionary_in_other_notation(text):
    assert found(text).entries == found(EDS).entries


def test_unknown_type_prints_nothing(capsys, monkeypatch):
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # as in a program, unlike in a test
    assert (
        found(EDS + entry_eds("2001", "x", "0x40", "rw", "DefaultValue=5"))
        .entries[0x2001, 0]
        .problem
        == ""
    )
    assert capsys.readouterr().err == ""


BROKEN = [
    ("PDOMapping=1\n", "PDOMapping=\n"),
    ("SubNumber=", "SubNumber=x"),
    ("DataType=0x0007\nAccessType=rw\nDefaultValue=420", "DataType=?\nAccessType=rw"),
    ("ObjectType=7\nDataType=0x0009", "ObjectType=07\nDataType="),
    ("ParameterName=mode\n", ""),
    ("[1000]\n", "[DummyUsage]\nDummy0002=1\nDummy0005=yes\n[Comments]\nLines=many\n[1000]\n"),
    ("AccessType=ro\n", ""),
]


@pytest.mark.parametrize(("old", "new"), BROKEN)
def test_entries_outside_pdos_may_be_unreadable(old, new):
    """A drive with the usual PDOs by its dictionary, of which other lines are damaged."""
    text, files = dictionary_and_text({})
    whole = files["dictionary:a.dcf"].decode().replace("AccessType=r", "PDOMapping=1\nAccessType=r")
    eds = whole + EDS.replace("[6041]", "[2041]").replace("[6064]", "[2064]").replace(
        "[6074]", "[2074]"
    ).replace("[1800", "[1810")
    assert old in eds
    (drive,) = bus_of(robot_of(text, {"dictionary:a.dcf": eds.replace(old, new).encode()})).drives
    assert [entry.mapping for entry in drive.tpdos[0].entries] == SENT_OBJECTS[1:]
    assert [entry.mapping for entry in drive.rpdos[0].entries] == TAKEN_OBJECTS[1:]


def line_of(eds: str, section: str, key: str) -> int:
    return eds.count("\n", 0, eds.index(f"\n{key}=", eds.index(f"[{section}]")) + 1) + 1


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("[1A00sub2]", "[1A00sub5]", "tpdo 1: 1A00:2 is not known. Provide all 3 entries"),
        ("=0x60640020", "=0x60640020 // position", "tpdo 1: 1A00:2 a.dcf: line {}: DefaultValue"),
        ("=0x60640020", "=", "tpdo 1: 1A00:2 a.dcf: line {}: DefaultValue is empty"),
        (
            "=0x60640020",
            "=0x60640020\nParameterValue=-",
            "1A00:2 a.dcf: line {1}: ParameterValue =",
        ),
        ("=0x3\n", "=0xFFFFFFFF\n", "tpdo 1: 1A00:4 is not known"),
        ("=0x60640020", "=0x600640020", "no PDO from the drive carries 6064:0"),
        ("=0x3\n", "=O3\n", "no PDO from the drive carries 6064:0: 1A00:0 a.dcf: line"),
    ],
)
def test_unreadable_pdo_entry_is_refused(old, new, expected):
    text, files = dictionary_and_text({})
    eds = files["dictionary:a.dcf"].decode()
    assert old in eds
    line = line_of(eds, "1A00sub2", "DefaultValue")
    damaged = {"dictionary:a.dcf": eds.replace(old, new, 1).encode()}
    refused(text, expected.format(line, line + 1), damaged)


COMPACT = "[1A00]\nParameterName=x\nObjectType=0x8\nDataType=0x0007\nAccessType=rw\n"
VALUES = "\n".join(f"{k}=0x{word:X}" for k, word in enumerate(SENT_OBJECTS[1:], 1)) + "\n"
COMPACTS = {
    "values": "CompactSubObj=3\nDefaultValue=0\n[1A00Value]\nNrOfEntries=3\n" + VALUES,
    "room for more": "CompactSubObj=0x8\nDefaultValue=0\n[1A00Value]\nNrOfEntries=3\n" + VALUES,
    "values first": "CompactSubObj=003\n[1a00VALUE]\nNrOfEntries=0x3\n" + VALUES,
    "with names": "CompactSubObj=3\n[1A00Value]\nNrOfEntries=3\n"
    + VALUES
    + "[1A00Name]\nNrOfEntries=1\n2=position\n",
    "an entry of its own": "CompactSubObj=3\n[1A00Value]\nNrOfEntries=2\n"
    + VALUES.replace("0x60640020", "0x60740010")
    + entry_eds("1A00sub2", "s", "7", "rw", "DefaultValue=0x60640020"),
}


def compact(lines: str) -> tuple[str, dict[str, bytes]]:
    text, files = dictionary_and_text({})
    eds = re.sub(r"(?s)\[1A00\].*?(?=\[1400\])", "", files["dictionary:a.dcf"].decode())
    assert "1A00" not in eds
    return text, {"dictionary:a.dcf": (eds + COMPACT + lines).encode()}


@pytest.mark.parametrize("lines", COMPACTS.values(), ids=COMPACTS)
def test_compact_storage(lines):
    """CiA 306: the number of sub-indices, and the values of those that have other ones."""
    (drive,) = bus_of(robot_of(*compact(lines))).drives
    assert [entry.mapping for entry in drive.tpdos[0].entries] == SENT_OBJECTS[1:]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (
            "CompactSubObj=3\n[1A00Value]\nNrOfEntries=2\n2=0x60640020\n",
            "tpdo 1: 1A00:1 is not known",
        ),
        (
            COMPACTS["values"].replace("2=0x60640020", "2=position"),
            ": 2 = 'position' is not a number",
        ),
        (COMPACTS["values"].replace("Obj=3", "Obj=three"), "1A00:0 a.dcf: line "),
        (COMPACTS["values"].replace("Obj=3", "Obj=0"), "no PDO from the drive carries 6064:0"),
    ],
)
def test_incomplete_compact_storage(lines, expected):
    refused(*compact(lines)[:1], expected, compact(lines)[1])


def test_described_range_has_type_of_values():
    """CANFestival: a type beyond those of CiA 301 is described in [A0]."""
    text = EDS + entry_eds("2001", "x", "0xA0", "rw", "DefaultValue=5")
    text += "[A0]\nParameterName=r\n[A0sub1]\nParameterName=t\nDefaultValue=0x6\n"
    assert found(text).entries[0x2001, 0].type == "U16"


def test_reason_for_object_without_type():
    text = bus_text(1, drive='dictionary = "a.eds"').replace(
        'reference = "6074"', 'reference = "2074"'
    )
    eds = EDS.replace("[6074]", "[2074]").replace("DataType=0x0003", "DataType=3 bytes")
    told = "a.eds: line 38: DataType = '3 bytes' is not a number"
    refused(text, told, {"dictionary:a.eds": eds.encode()})


def test_reason_for_object_outside_pdos():
    text, files = dictionary_and_text({0x1800: [1, 0]})
    name = entry_eds("1008", "device name", "0x0007", "const", "DefaultValue=Gold").encode()
    told = "no PDO from the drive carries 6064:0. Map it"
    refused(text, told, {"dictionary:a.dcf": name + files["dictionary:a.dcf"]})
