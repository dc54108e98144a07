"""Raw integers into SI as descriptions of drives have it: every number worked out by hand."""

import numpy as np
import pytest
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.protocol import EffortCodec, ObjectEntry, PositionCodec, saturated
from acquisition.robot import Drive

TURN = 2 * np.pi
TORQUE = 'reference = "6074"\nrated_torque_nm ='
OF_FORCE = 'reference_rule = "per mille of rated force"\nrated_force_n ='


def direct(index: int, kind: str, rule: str = "") -> str:
    """Keys of a drive whose reference is an object of its maker."""
    stated = f'\nreference_rule = "{rule}"' if rule else ""
    return f'reference = "{index:X}"\nobjects = {{ "{index:X}" = "{kind}" }}{stated}'


# Unit of the motor's effort, keys of the drive, raw integer, SI by hand.
EFFORTS = {
    "6074 of a rated torque of 0.42 N m": ("N m", f"{TORQUE} 0.42", 500, 0.21),
    "6078 of a rated current of 5 A": ("A", 'actual = "6078"\nrated_current_a = 5.0', 1100, 5.5),
    "6077 that its maker means by current":
        ("A", 'actual = "6077"\nactual_rule = "per mille of rated current"\nrated_current_a = 2.0',
         30, 0.06),
    "a linear motor of 80 N": ("N", f'reference = "6074"\n{OF_FORCE} 80.0', 250, 20.0),
    "an EPOS2's current in mA": ("A", direct(0x2031, "I16"), -750, -0.75),
    "a Copley's current in 0.01 A": ("A", direct(0x221E, "I16"), 250, 2.5),
    "millivolts": ("V", direct(0x2200, "I16", "mV"), -10_000, -10.0),
    "mN m": ("N m", direct(0x2201, "I32", "mN m"), 420, 0.42),
    "mN": ("N", direct(0x2203, "I32", "mN"), 1500, 1.5),
}  # fmt: skip


def drive_of(keys: str, unit: str = "N m", counts: str = "counts_per_turn = 65536") -> Drive:
    text = bus_text(1).replace(f"{TORQUE} 0.42\ncounts_per_turn = 65536", f"{keys}\n{counts}")
    text = text.replace('effort_unit = "N m"', f'effort_unit = "{unit}"')
    if unit == "N":
        text = text.replace('"revolute"', '"prismatic"').replace("counts_per_turn", "counts_per_m")
        text = "\n".join(line for line in text.split("\n") if "_deg" not in line or "dh" in line)
    return bus_of(robot_of(text)).drives[0]


@pytest.mark.parametrize(
    ("signs", "expected"),
    [
        ("", 1),
        ("sign = -1", -1),
        ("sign = 1\neffort_sign = -1", -1),
        ("sign = -1\neffort_sign = 1", 1),
    ],
)
@pytest.mark.parametrize("name", EFFORTS)
def test_efforts_by_hand(name, signs, expected):
    """`effort_sign` tells; where it is left out `sign` does, for efforts as for positions."""
    unit, keys, raw, value = EFFORTS[name]
    codec = drive_of(f"{keys}\n{signs}", unit).effort
    assert codec.si(np.array([raw, 0, -raw])) == pytest.approx(
        np.array([value, 0.0, -value]) * expected, rel=1e-12
    )
    assert codec.raw(np.array([value, -value]) * expected).tolist() == [raw, -raw]
    assert codec.provenance.endswith(f", sign {'+1' if expected == 1 else '-1'}")


@pytest.mark.parametrize(
    ("keys", "unit", "expected"),
    [
        ('actual = "6078"\nrated_current_a = 5.0', "A", {0x6075: 5000}),
        (f"{TORQUE} 0.1053", "N m", {0x6076: 105}),
        (f'{TORQUE} 0.1053\nrated_torque_unit = "uN m"', "N m", {0x6076: 105_300}),
        (f'reference = "6074"\n{OF_FORCE} 80.0\nrated_torque_unit = "mN"', "N", {0x6076: 80_000}),
        ('actual = "6078"\nrated_current_a = 2.5\nrated_torque_nm = 0.5\nrated_torque_unit '
         '= "uN m"', "A",
         {0x6075: 2500, 0x6076: 500_000}),
        (direct(0x30D0, "I32"), "A", {}),
    ],
)  # fmt: skip
def test_rated_values_of_drive(keys, unit, expected):
    """6075h in mA, 6076h in mN m; in an EPOS4 6076h is µN m, a thousand times as many."""
    assert drive_of(keys, unit).rated == expected


@pytest.mark.parametrize(
    ("signs", "raw", "turns"),
    [
        ("", -65536, -1.0),
        ("zero_counts = 1000", 1000 + 32768, 0.5),
        ("sign = -1\nzero_counts = -70000", -70000 - 6554 * 10, 65540 / 65536),
        ("effort_sign = -1", 16384, 0.25),  # of efforts alone
    ],
)
def test_rotary_motor_positions(signs, raw, turns):
    codec = drive_of(f'reference = "6074"\nrated_torque_nm = 0.42\n{signs}').position_codec
    assert codec.si(np.array([raw])) == pytest.approx([turns * TURN], rel=1e-12)
    assert codec.exact(np.array([turns * TURN])) == pytest.approx([raw], rel=1e-12)
    assert codec.raw(np.array([turns * TURN])).tolist() == [raw]


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [("I8", -128, 127), ("I16", -32768, 32767), ("I32", -2147483648, 2147483647), ("U8", 0, 255),
     ("U16", 0, 65535),
     ("U32", 0, 4294967295)],
)  # fmt: skip
def test_integers_saturate_at_type_limits(kind, low, high):
    values = [
        low - 1e12,
        low - 1,
        low - 0.4,
        low,
        low + 0.6,
        high - 0.6,
        high,
        high + 0.4,
        high + 1,
        high + 1e12,
    ]
    expected = [low, low, low, low, low + 1, high - 1, high, high, high, high]
    assert saturated(np.array(values), kind).tolist() == expected
    assert saturated(np.array([1.4, 1.6, 0.5, 2.5]), kind).tolist() == [1, 2, 0, 2]


def test_codecs_saturate_at_object_limits():
    effort = EffortCodec(
        entry=ObjectEntry(index=0x2031, sub=0, type="I16"), scale=-1e-3, provenance=""
    )
    assert effort.raw(np.array([32.767, 32.768, -1e9])).tolist() == [-32767, -32768, 32767]
    position = PositionCodec(counts_per_unit=1e6, sign=-1, zero_counts=5)
    assert position.raw(np.array([-2147.483643, 2147.483654])).tolist() == [2**31 - 1, -(2**31)]
