"""`[bus]` and its PDOs: resolved, or refused in one line that says what to change."""

import re

import numpy as np
import pytest
from made_up_buses import bus_of, bus_text, refused, robot_of

from acquisition.errors import BadInputError
from acquisition.protocol import ObjectEntry
from acquisition.robot import parse_homed, refuse_load, refuse_out_of_range, resolve


def test_six_axes_bus_rate():
    bus = bus_of(robot_of(bus_text(6)))
    assert bus.load == pytest.approx(0.7775)
    refuse_load(bus, "robot.toml")
    fast = bus_of(robot_of(bus_text(6, period_s=0.001)))  # for a listener, who sends none of it
    with pytest.raises(BadInputError, match="156% of 1000000 bit/s") as caught:
        refuse_load(fast, "robot.toml")
    assert (caught.value.key, caught.value.advice[:21]) == (
        "bus.sync_period_s",
        "Set at least 0.0016 s",
    )


CHANGES = [
    (("node = 2", "node = 1"), "bus.drive[1].node = 1: another drive has it"),
    (("sync_period_s = 0.002", "sync_period_s = 0.00009"),
     "bus.sync_period_s = 9e-05: expected 0.0001 to 1"),
    (("sync_period_s = 0.002", "sync_period_s = 1.001"),
     "bus.sync_period_s = 1.001: expected 0.0001 to 1"),
    (("sync_period_s = 0.002", "sync_period_s = 0.002\nmaster_node = 2"),
     "bus.master_node = 2: a drive has it. Choose another node id."),
    (("sync_period_s = 0.002", "sync_period_s = 0.002\nother_nodes = [5, 1]"),
     "bus.other_nodes = 1: a drive or master_node has it"),
    (('reference = "6074"', 'reference = "6074"\nreference_rule = "mA"'),
     "'mA': it gives A, but motor 'motor_1' has N m. Correct it"),
    (('reference = "6074"', 'reference = "2222"'), "reference = '2222': its type is not known"),
    (('reference = "6074"', 'reference = "2222"\nobjects = { 2222 = "I16" }'),
     "reference_rule is missing: the unit of 2222:0 (I16) is unknown: expected one of"),
    (('reference = "6074"', ""), "reference is missing. Name the object of the current or "
                                 "torque reference"),
    (("rated_torque_nm = 0.42", ""), "rated_torque_nm is missing. Give the rated value"),
    (("= 0.42", "= 1\nrated_current_a = 1e9"), "drive[0].rated_current_a = 1000000000.0: expected "
                                               "0.001 to "),
    (("counts_per_turn = 65536", ""), "counts_per_turn is missing. Give counts_per_turn or "
                                      "counts_per_m"),
    # The identifiers of other services.
    *((("[bus]", f"[bus]\nsync_can_id = {i}"), f"bus.sync_can_id = {i}: expected 0x80, or 0x680 "
                                               "to 0x6DF")
      for i in ("0x1", "0x81", "0x181", "0x57F", "0x601", "0x701", "0x7FF")),
]  # fmt: skip
OF_DRIVE = [
    ('dictionary = "../x.eds"', "dictionary = '../x.eds': expected the name of a file in"),
    ('dictionary = "a.eds"', "bus.drive[0].dictionary = 'a.eds': the file is missing "
                             "beside robot.toml"),
    ('mapping = "dictionary"', "no dictionary is given. Name the EDS or DCF"),
    ('tpdo = [{ objects = ["6041", "6064", "606C"] }]', "2 + 4 + 4 = 10 bytes, more than 8. Use"),
    ('tpdo = [{ objects = ["6041", "6064"] }]', "no PDO from the drive carries 6074:0"),
    ('tpdo = [{ objects = ["6041", "6064"] }, { objects = ["6074"], number = 1, can_id = '
     '0x281 }]', "is used twice"),
    ('rpdo = [{ objects = ["6040"], can_id = 0x80 }]', "0x080 belongs to another service"),
    ('rpdo = [{ objects = ["6040"], can_id = 0x182 }]',
     "0x182 is also that of a PDO of motor_1. Give each PDO its own"),
    ('rpdo = [{ objects = ["6040"], number = 5 }]', "can_id is missing"),
    ('rated_torque_unit = "Nm"', "rated_torque_unit = 'Nm': expected one of mA, mN m, uN m"),
    ("counts_per_m = 5", "counts_per_m is given too. Give counts_per_turn or counts_per_m"),
    ('objects = { "6064" = "I16" }', "position = '6064': its type is I16: expected I32"),
    ('objects = { "607A" = "U32" }', "target = '607A': its type is U32: expected I32"),
    ('extra = ["2081:1"]', "extra[0] = '2081:1': its type is not known"),
    ('extra = ["606C"]\ntpdo = [{ objects = ["6041", "6064", "6074"] }]',
     "no PDO from the drive carries 606C:0"),
    ("extra = [{ scale = 0.1 }]", "bus.drive[0].extra[0] = '': expected an object, such as 606C "
                                  "or 2081:1"),
    *((f'homed = "{name}"', "homed") for name in ("6041.32", "604", "6041.", "6041.8.1")),
]  # fmt: skip


@pytest.mark.parametrize(("change", "expected"), CHANGES)
def test_refused_in_one_line(change, expected):
    assert change[0] in bus_text()
    refused(bus_text().replace(*change, 1), expected)


def test_one_drive_per_motor():
    text = bus_text(2)
    refused(
        text[: text.rindex("[[bus.drive]]")], "bus.drive = '1 tables': expected 2, one per motor"
    )
    with pytest.raises(
        BadInputError, match=r"r.toml: bus is missing. Describe the drives: remove `#: `"
    ):
        resolve(robot_of(text[: text.index("[bus]")]), "r.toml")


@pytest.mark.parametrize(("lines", "expected"), OF_DRIVE)
def test_drive_keys_refused_in_one_line(lines, expected):
    refused(bus_text(drive=lines), expected)


@pytest.mark.parametrize(
    "change",
    [
        ("0.002", "0.0001"),
        ("0.002", "1.0"),
        ('channel = "test"', 'channel = "test"\nmaster_node = 2'),
        ("[bus]", "[bus]\nsync_can_id = 0x6DF"),
        # Rates of CiA 301, and 100 kbit/s, which it had before.
        *(
            ("[bus]", f"[bus]\nbitrate = {rate}000")
            for rate in (10, 20, 50, 100, 125, 250, 500, 800, 1000)
        ),
    ],
)
def test_range_limits(change):
    assert change[0] in bus_text(1)
    found = robot_of(bus_text(1).replace(*change)).bus
    key, _, value = change[1].rpartition("\n")[2].partition(" = ")
    assert key not in ("bitrate", "sync_can_id") or getattr(found, key) == int(value, 0)


def test_targets_beyond_object_range():
    robot = robot_of(bus_text(2).replace("node = 2\n", "node = 2\nsign = -1\n"))
    bus, most = bus_of(robot), (2**31 - 1) / 65536 / 50 * 2 * np.pi  # of joint 1, at a ratio of 50
    path = np.zeros((5, 2))
    path[3] = most * (1 - 1e-12)
    refuse_out_of_range(path, robot, bus, "x")
    for target, told in (
        ([most * 1.001, 0], "node 1 (motor_1) = 2149631"),
        ([0, most * 1.001], "node 2 (motor_2) = -2149631"),
        ([np.nan, 0], "node 1 (motor_1) = nan counts"),
        ([0, 1e308], "node 2 (motor_2) = -inf counts"),
    ):
        path[3] = target
        with pytest.raises(BadInputError, match=re.escape(f"x: at 0.006 s: target of {told}")):
            refuse_out_of_range(path, robot, bus, "x")


@pytest.mark.parametrize(
    ("kind", "unit", "counts", "expected"),
    [
        ("revolute", "A", "counts_per_turn", None),
        ("revolute", "A", "counts_per_m", "moves no prismatic joint. Use counts_per_turn"),
        ("prismatic", "A", "counts_per_turn", None),  # a spindle
        ("prismatic", "A", "counts_per_m", None),
        ("prismatic", "N", "counts_per_m", None),
        ("prismatic", "N", "counts_per_turn", "gives a force. Use counts_per_m"),
        ("prismatic", "N m", "counts_per_m", "gives a torque. Use counts_per_turn"),
    ],
)
def test_counts_per_turn_of_rotary_motors(kind, unit, counts, expected):
    text = bus_text(1, drive=f'reference_rule = "m{unit}"').replace('"N m"', f'"{unit}"')
    text = text.replace("counts_per_turn", counts).replace('"revolute"', f'"{kind}"')
    if kind == "prismatic":
        text = re.sub("^[a-z]+(_error)?_deg.*$", "", text, flags=re.MULTILINE)
    if expected is None:
        assert bus_of(robot_of(text)).drives[0].name == "motor_1"
    else:
        refused(text, expected)


def test_object_names():
    assert parse_homed("6064") == (0x6064, 0, None)
    assert parse_homed("60c2:2") == (0x60C2, 2, None)
    assert parse_homed("1018:10") == (0x1018, 10, None)


def entries(pdo) -> list[str]:
    return [str(entry) for entry in pdo.entries]


def test_too_many_objects_use_two_pdos():
    """Statusword, position and a reference of 32 bits are 10 bytes."""
    text = bus_text(1).replace(
        'reference = "6074"', 'reference = "30D0"\nobjects = { "30D0" = "I32" }'
    )
    drive = bus_of(
        robot_of(text.replace('"N m"', '"A"').replace("node = 1\n", "node = 9\n"))
    ).drives[0]
    assert [(pdo.number, pdo.can_id, pdo.length, entries(pdo)) for pdo in drive.tpdos] == [
        (1, 0x189, 6, ["6041:0", "6064:0"]),
        (2, 0x289, 4, ["30D0:0"]),
    ]
    assert drive.carrier(ObjectEntry(index=0x30D0, sub=0, type="I32"), "tpdo") is drive.tpdos[1]
    assert drive.carrier(drive.target, "rpdo") is drive.rpdos[0]
    assert drive.carrier(drive.target, "tpdo") is None
    # PDOs of a description with numbers and identifiers.
    line = (
        'tpdo = [{ objects = ["6064", "6074"], number = 3 }, { objects = ["6041"], can_id = '
        "0x6A0, number = 7 }]\n"
    )
    drive = bus_of(robot_of(bus_text(1, drive=line))).drives[0]
    assert [(pdo.number, pdo.can_id, entries(pdo)) for pdo in drive.tpdos] == [
        (3, 0x381, ["6064:0", "6074:0"]),
        (7, 0x6A0, ["6041:0"]),
    ]
