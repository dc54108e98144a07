"""`[bus]` of robot.toml: the CAN interface, SYNC and the drives, as written in the file.

`resolving` combines it with the object dictionaries.
"""

import math
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import msgspec

from ..protocol import BITS, EFFORT_OBJECTS, RATED_UNITS, RULES
from .toml import Positive, TomlTable, note, parse_toml

Node = Annotated[int, msgspec.Meta(ge=1, le=127)]
CanId = Annotated[int, msgspec.Meta(ge=1, le=0x7FF)]
_OBJECT = r"\A[0-9A-Fa-f]{4}(:[0-9]{1,3})?\Z"
ObjectName = Annotated[str, msgspec.Meta(pattern=_OBJECT)]
HomedName = Annotated[
    str, msgspec.Meta(pattern=r"\A[0-9A-Fa-f]{4}(:[0-9]{1,3})?(\.([0-9]|[12][0-9]|3[01]))?\Z")
]
Counts = Annotated[float, msgspec.Meta(gt=0, le=1e12)]  # per turn or metre
Word = Annotated[str, msgspec.Meta(min_length=1, max_length=64, pattern=r"\A[A-Za-z0-9_.:/\-]+\Z")]
Sign = Literal[1, -1]
# The instants to which recorded efforts belong.
EffortTiming = Literal["command", "mean", "measured", "unknown"]

MAX_DEMAND_RIPPLE = 0.002  # share of the inertia
TORQUE_DEMAND = 0x6074
USUAL_SYNC = 0x80
# A program marks lines of a description that an engineer must complete.
FILL_IN = "FILL IN"
AXIS = 0x800  # distance between the objects of two axes of a drive (CiA 402-2)
_WORDS: dict[str, Iterable[str]] = {
    **dict.fromkeys(("reference_rule", "actual_rule"), RULES),
    **dict.fromkeys(("rated_current_unit", "rated_torque_unit"), RATED_UNITS),
}
BITRATES = (10_000, 20_000, 50_000, 100_000, 125_000, 250_000, 500_000, 800_000, 1_000_000)


class PdoFile(TomlTable, frozen=True):
    """A PDO: its objects in order, and its identifier and number if they are not the usual ones."""

    objects: Annotated[
        tuple[ObjectName, ...], note("mapped objects, in order", min_length=1, max_length=8)
    ]
    can_id: Annotated[
        CanId | None, note("CAN identifier (default: the usual one for its number)")
    ] = None
    number: Annotated[
        Annotated[int, msgspec.Meta(ge=1, le=512)] | None,
        note("number of the PDO (default: its place in the list)"),
    ] = None


class DriveFile(TomlTable, frozen=True):
    """One `[[bus.drive]]`, in the order of the motors."""

    node: Annotated[Node, note("node id")]
    station: Annotated[
        Annotated[int, msgspec.Meta(ge=0, le=0xFFFF)] | None,
        note(
            "EtherCAT station address in a capture (default: the next slave that sends "
            "the position)"
        ),
    ] = None
    dictionary: Annotated[
        str | None, note("object dictionary (EDS or DCF), a file in the folder of robot.toml")
    ] = None
    objects: Annotated[
        dict[ObjectName, str],
        note("types of objects, such as I32, in place of a dictionary or in addition to it"),
    ] = msgspec.field(default_factory=dict)
    status: Annotated[ObjectName, note("statusword")] = "6041"
    control: Annotated[ObjectName, note("controlword")] = "6040"
    position: Annotated[ObjectName, note("actual position (type I32), counts")] = "6064"
    target: Annotated[ObjectName, note("target position (type I32), counts")] = "607A"
    reference: Annotated[
        ObjectName | None, note("reference of the current or torque loop, such as 6074")
    ] = None
    reference_rule: Annotated[
        str | None, note("unit of the raw integer (default: that of CiA 402)")
    ] = None
    actual: Annotated[
        ObjectName | None, note("actual current or torque, if the drive has no reference")
    ] = None
    actual_rule: Annotated[
        str | None, note("unit of the raw integer (default: that of CiA 402)")
    ] = None
    rated_current_a: Annotated[
        Positive | None, note("rated current, A: the required value of 6075h")
    ] = None
    rated_torque_nm: Annotated[
        Positive | None, note("rated torque, N m: the required value of 6076h")
    ] = None
    rated_force_n: Annotated[
        Positive | None, note("rated force of a linear motor, N: the required value of 6076h")
    ] = None
    rated_current_unit: Annotated[str, note("unit of 6075h in the drive")] = "mA"
    rated_torque_unit: Annotated[str, note("unit of 6076h in the drive; uN m for an EPOS4")] = (
        "mN m"
    )
    counts_per_turn: Annotated[Counts | None, note("position counts per motor revolution")] = None
    counts_per_m: Annotated[Counts | None, note("position counts per metre of a linear motor")] = (
        None
    )
    sign: Annotated[Sign, note("-1 if the drive counts against the motor")] = 1
    effort_sign: Annotated[
        Sign | None, note("-1 if the effort acts against the motor (default: sign)")
    ] = None
    zero_counts: Annotated[
        int, note("position at motor position 0, counts", ge=-(2**31), lt=2**31)
    ] = 0
    homed: Annotated[
        HomedName | None,
        note(
            "what shows that the drive is homed: a bit that is set, such as 6041.8, or "
            "an object that is not 0, such as 2000:1"
        ),
    ] = None
    mapping: Annotated[
        Literal["table", "dictionary", "traffic"],
        note(
            "source of the PDOs: this table, a DCF (dictionary), or what the drives "
            "confirmed by SDO (traffic)"
        ),
    ] = "table"
    tpdo: Annotated[
        tuple[PdoFile, ...], note("PDOs from the drive (default: status, position, effort)")
    ] = ()
    rpdo: Annotated[tuple[PdoFile, ...], note("PDOs to the drive (default: control, target)")] = ()
    extra: Annotated[
        tuple[ObjectName | dict[str, Any], ...],
        note("further objects that the drive sends at each SYNC, such as 606C; kept in the frames"),
    ] = ()

    def __post_init__(self) -> None:
        words = {key: getattr(self, key) for key in _WORDS}
        self.require_all(
            *(
                (kind in BITS, f"objects[{name}]", kind, f"one of {', '.join(BITS)}")
                for name, kind in self.objects.items()
            ),
            (
                self.reference is not None or self.actual is not None,
                "reference",
                None,
                ("", "Name the object of the current or torque reference, or set actual"),
            ),
            *(
                (
                    re.fullmatch(_OBJECT, name),
                    f"extra[{k}]",
                    name,
                    "an object, such as 606C or 2081:1",
                )
                for k, name in enumerate(self.extra_objects)
            ),
            *(
                (word is None or word in _WORDS[key], key, word, f"one of {', '.join(_WORDS[key])}")
                for key, word in words.items()
            ),
        )
        for key, unit in (
            ("rated_current_a", self.rated_current_unit),
            ("rated_torque_nm", self.rated_torque_unit),
            ("rated_force_n", self.rated_torque_unit),
        ):
            value, most = getattr(self, key), (2**32 - 1) * RATED_UNITS[unit]
            self.require(
                value is None or RATED_UNITS[unit] <= value <= most,
                key,
                value,
                f"{RATED_UNITS[unit]:g} to {most:.4g}, 32 bits in {unit}",
            )
        self.require_all(
            (
                (self.counts_per_turn is None) != (self.counts_per_m is None),
                "counts_per_turn",
                self.counts_per_turn,
                (
                    "" if self.counts_per_turn is None else "counts_per_m is given too",
                    "Give counts_per_turn or counts_per_m",
                ),
            ),
            (
                self.dictionary is None or re.fullmatch(r"[^/\\\x00-\x1f]+", self.dictionary),
                "dictionary",
                self.dictionary,
                "the name of a file in the folder of robot.toml",
            ),
            (
                self.mapping != "dictionary" or self.dictionary is not None,
                "mapping",
                self.mapping,
                ("no dictionary is given", "Name the EDS or DCF that contains the mapping"),
            ),
        )

    @property
    def counts_per_unit(self) -> float:
        """Counts per rad or m of the motor."""
        return self.counts_per_m or (self.counts_per_turn or 0.0) / (2 * math.pi)

    @property
    def extra_objects(self) -> tuple[str, ...]:
        """Names in `extra`.

        In older recordings these are tables, with the name and scale of a column of samples.
        """
        return tuple(
            extra if isinstance(extra, str) else str(extra.get("object", ""))
            for extra in self.extra
        )

    @property
    def reports_demand(self) -> bool:
        """True if the effort is a torque demand value (6074h of any axis).

        This value is that of one control step.
        """
        return (
            parse_object(self.reference or self.actual or "0000")[0] - TORQUE_DEMAND
        ) % AXIS == 0


class BusFile(TomlTable, frozen=True):
    """`[bus]`: interface and channel of python-can, SYNC, the drives."""

    interface: Annotated[Word, note("interface of python-can, such as socketcan or udp_multicast")]
    channel: Annotated[
        Word,
        note(
            "channel of python-can, such as can0; the one to import from a log of "
            'several, also "1" for CAN 1'
        ),
    ]
    drive: Annotated[
        tuple[DriveFile, ...],
        note("[[bus.drive]] tables, in the order of the motors", min_length=1),
    ]
    sync_period_s: Annotated[Positive, note("SYNC period, s (0.0001 to 1)")]
    bitrate: Annotated[int, note("bit rate of the bus, bit/s")] = 1_000_000
    sync_producer: Annotated[
        Literal["recorder", "other"],
        note("who sends SYNC: this program (recorder), or another device (other)"),
    ] = "recorder"
    sync_can_id: Annotated[CanId, note("CAN identifier of SYNC")] = USUAL_SYNC
    loopback: Annotated[bool, note("whether udp_multicast stays on this machine")] = True
    heartbeat_s: Annotated[
        float,
        note(
            "time between heartbeats, s; silence for three times as long is a fault",
            ge=0.01,
            le=10.0,
        ),
    ] = 0.1
    master_node: Annotated[
        Node, note("node id of this program's heartbeat during motion; no drive may have it")
    ] = 127
    other_nodes: Annotated[
        tuple[Node, ...], note("node ids of further devices, such as grippers")
    ] = ()
    late_sync_s: Annotated[
        Positive | None,
        note("maximum delay of SYNC during motion, s (default: 3 periods, at least 0.02)"),
    ] = None
    enable_motion_deg: Annotated[
        Positive, note("maximum motion of a revolute joint while drives are enabled, deg")
    ] = 1.0
    enable_motion_m: Annotated[
        Positive, note("maximum motion of a prismatic joint while drives are enabled, m")
    ] = 0.005
    enable_watch_s: Annotated[
        float,
        note(
            "time for which this limit applies after the last drive is enabled, s", ge=0.05, le=10.0
        ),
    ] = 0.2
    effort_timing: Annotated[
        EffortTiming,
        note(
            "what an effort is: the command that holds after the sample, the mean around it, "
            "or the value at it"
        ),
    ] = "unknown"

    def __post_init__(self) -> None:
        nodes, period_s = [drive.node for drive in self.drive], self.sync_period_s
        self.require_all(
            (
                self.bitrate in BITRATES,
                "bitrate",
                self.bitrate,
                f"one of {', '.join(map(str, BITRATES))}",
            ),
            (1e-4 <= period_s <= 1.0, "sync_period_s", period_s, "0.0001 to 1"),
            (
                self.master_node not in nodes,
                "master_node",
                self.master_node,
                ("a drive has it", "Choose another node id"),
            ),
            *(
                (
                    node not in (*nodes, self.master_node),
                    "other_nodes",
                    node,
                    ("a drive or master_node has it", ""),
                )
                for node in self.other_nodes
            ),
            *(
                (node not in nodes[:i], f"drive[{i}].node", node, ("another drive has it", ""))
                for i, node in enumerate(nodes)
            ),
        )

    @property
    def mapped_by_traffic(self) -> bool:
        """True if PDOs of a drive are only known from the SDO writes of another master."""
        return any(drive.mapping == "traffic" for drive in self.drive)


def demand_ripple(bandwidth_hz: float, sync_period_s: float) -> float:
    """Compute the ripple of a torque demand value at SYNC, as a share of the inertia.

    The ripple is the difference of the value from its mean.

        (w T)²/3,     w = 2 pi bandwidth_hz,     T = sync_period_s
    """
    # A drive that interpolates its targets linearly deviates from them between two SYNCs, in
    # proportion to the acceleration, and its loops (the velocity loop four times as fast) demand a
    # torque for it. At SYNC this deviation is always the same.
    return (2 * math.pi * bandwidth_hz * sync_period_s) ** 2 / 3


def ripple_notes(bus: BusFile | None, bandwidth_hz: float | None) -> tuple[str, ...]:
    """Return a note if an effort is a torque demand value whose ripple may be large."""
    if bus is None or bandwidth_hz is None or not any(drive.reports_demand for drive in bus.drive):
        return ()
    if (ripple := demand_ripple(bandwidth_hz, bus.sync_period_s)) <= MAX_DEMAND_RIPPLE:
        return ()
    return (
        "the torque demand value (6074) is read once per SYNC, so inertia may be wrong by "
        f"{100 * ripple:.1f} % if drives interpolate linearly: shorten sync_period_s, or record an "
        "averaged object",
    )


class _Drives(msgspec.Struct):
    drive: tuple[dict[str, Any], ...]


class _Scanned(msgspec.Struct):
    bus: _Drives


def efforts_of_scan(text: bytes, place: str) -> tuple[str, ...]:
    """Return the unit of the effort of each `[[bus.drive]]`, A, V, N m or N, by its rule or object.

    It is empty where both are still to be filled in. Other keys may be missing or wrong.
    """
    usual = {f"{index:04X}": rule for (index, _), (_, rule, _) in EFFORT_OBJECTS.items()}

    def unit(drive: dict[str, Any]) -> str:
        word = "reference" if "reference" in drive else "actual"
        by_object = usual.get(str(drive.get(word)).upper().removesuffix(":0"), "")
        rule = RULES.get(str(drive.get(f"{word}_rule", by_object)))
        return rule.unit if rule else ""

    return tuple(map(unit, parse_toml(text, _Scanned, place).bus.drive))


def parse_object(name: str) -> tuple[int, int]:
    """Parse `6064` or `6064:0` into index and sub-index."""
    index, _, sub = name.partition(":")
    return int(index, 16), int(sub or "0")


def parse_homed(name: str) -> tuple[int, int, int | None]:
    """Parse `6041.8` into index, sub-index and bit; the bit is None if the whole object counts."""
    entry, _, bit = name.partition(".")
    return *parse_object(entry), int(bit) if bit else None


def dictionary_label(name: str) -> str:
    """Return the name of a dictionary's attachment in a recording: a label, never a path."""
    return f"dictionary:{name}"
