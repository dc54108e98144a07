"""The drives of a robot, resolved from the description, and checks of their PDOs."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .. import protocol as cia
from ..arrays import Array, first_true
from ..errors import Location
from .bus import AXIS, USUAL_SYNC, BusFile, DriveFile
from .robot import Robot

MAX_LOAD = 0.95  # of the bus, with the worst case of bit stuffing
# CiA 301 assigns these identifiers to no service.
FREE_CAN_IDS = range(0x680, 0x6E0)
# Codecs and the unwrapping of counters depend on this type of positions and their targets.
POSITION_TYPE = "I32"


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Limits of the joints that a motor moves, at the motor.

    A limit is None if one of these joints has no limit.

    Attributes:
        speed: counts/s.
        acceleration: counts/s².
        position: lowest and highest counts.
        rpm: the speed in revolutions per minute; None also if the motor slides.
        counts_per_joint: counts of the motor per degree or metre of its joints, and that unit.
        ratio: gear ratio of the motor, without sign; None if it moves several joints.
    """

    speed: float | None
    acceleration: float | None
    position: tuple[float, float] | None
    rpm: float | None
    counts_per_joint: tuple[float, str]
    ratio: float | None


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """A drive with its objects, PDOs and codecs.

    Attributes:
        file: its `[[bus.drive]]`.
        effort: codec of the recorded effort: the reference, or the actual value without a
            reference.
        tpdos: PDOs from the drive.
        rpdos: PDOs to the drive.
        extras: further objects in the PDOs.
        dictionary: object dictionary; None if robot.toml lists the objects.
        types: types of objects by robot.toml, the dictionary and the standards.
    """

    file: DriveFile
    name: str
    status: cia.ObjectEntry
    control: cia.ObjectEntry
    position: cia.ObjectEntry
    target: cia.ObjectEntry
    position_codec: cia.PositionCodec
    effort: cia.EffortCodec
    tpdos: tuple[cia.Pdo, ...]
    rpdos: tuple[cia.Pdo, ...]
    extras: tuple[cia.ObjectEntry, ...]
    dictionary: cia.ObjectDictionary | None
    types: Mapping[tuple[int, int], str]
    motion: Motion

    @property
    def node(self) -> int:
        """Node id."""
        return self.file.node

    @property
    def rated(self) -> Mapping[int, int]:
        """Required raw values of objects of the drive, by index."""
        file = self.file
        torque = file.rated_torque_nm if file.rated_torque_nm is not None else file.rated_force_n
        return {
            index: round(value / cia.RATED_UNITS[unit])
            for index, value, unit in (
                (cia.RATED_CURRENT, file.rated_current_a, file.rated_current_unit),
                (cia.RATED_TORQUE, torque, file.rated_torque_unit),
            )
            if value is not None
        }

    @property
    def entries(self) -> Mapping[tuple[int, int], cia.DictionaryEntry]:
        """Entries of the dictionary; none without one."""
        return {} if self.dictionary is None else self.dictionary.entries

    def size_of(self, index: int, sub: int) -> int:
        """Return the size of an object in bytes."""
        return cia.BITS[self.types.get((index, sub)) or cia.object_type(index, sub)] // 8

    def carrier(self, entry: cia.ObjectEntry, direction: str) -> cia.Pdo | None:
        """Return the PDO that carries an object; None if there is none.

        `direction` is `tpdo` or `rpdo`.
        """
        return next(
            (
                pdo
                for pdo in (self.tpdos if direction == "tpdo" else self.rpdos)
                if entry.key in [e.key for e in pdo.entries]
            ),
            None,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Bus:
    """The bus and its drives, in the order of the motors; `notes` are warnings about their PDOs."""

    file: BusFile
    drives: tuple[Drive, ...]
    notes: tuple[str, ...] = ()

    @property
    def period_ns(self) -> int:
        """SYNC period in ns."""
        return round(self.file.sync_period_s * 1e9)

    @property
    def bits(self) -> int:
        """Bits of SYNC and one frame of each PDO, with the worst case of bit stuffing."""
        return cia.frame_bits(0) + sum(
            cia.frame_bits(pdo.length)
            for drive in self.drives
            for pdo in (*drive.tpdos, *drive.rpdos)
        )

    @property
    def load(self) -> float:
        """Share of each period that `bits` take; above 1 they do not fit."""
        return self.bits / (self.file.bitrate * self.file.sync_period_s)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the dictionaries and PDOs of the drives."""
        texts = [drive.dictionary.warnings for drive in self.drives if drive.dictionary is not None]
        return tuple(dict.fromkeys((*(text for some in texts for text in some), *self.notes)))

    @property
    def provenance(self) -> str:
        """Origin of the efforts by drive; equal drives are listed together."""
        told = [(drive.name, drive.effort.provenance) for drive in self.drives]
        return "; ".join(
            f"{', '.join(name for name, other in told if other == text)}: {text}"
            for text in dict.fromkeys(text for _, text in told)
        )


def refuse_load(bus: Bus, place: str) -> None:
    """Refuse PDOs that do not fit between two SYNCs. Only sessions that send check this."""
    period_s = bus.file.sync_period_s
    Location(place, "bus").require(
        bus.load <= MAX_LOAD,
        "sync_period_s",
        period_s,
        text=f"the PDOs take {bus.load:.0%} of {bus.file.bitrate} bit/s, more than {MAX_LOAD:.0%}",
        advice=f"Set at least {bus.load * period_s / MAX_LOAD:.2g} s, or use fewer PDOs",
        shown=f"{period_s:g}",
    )


def refuse_out_of_range(path: Array, robot: Robot, bus: Bus, place: str) -> None:
    """Refuse positions (N, n), one row per SYNC, beyond the range of a drive's target.

    This drive would stop while the others continue.
    """
    low, high = cia.range_of(POSITION_TYPE)
    # Values that are not finite are refused below.
    with np.errstate(over="ignore", invalid="ignore"):
        motors = robot.motor_position(path)
        for i, drive in enumerate(bus.drives):
            counts = drive.position_codec.exact(motors[:, i])
            # NaN fails both comparisons, so it is outside.
            inside = (np.rint(counts) >= low) & (np.rint(counts) <= high)
            if (k := first_true(~inside)) is not None:
                Location(f"{place}: at {k * bus.file.sync_period_s:.4g} s").refuse(
                    f"target of node {drive.node} ({drive.name})",
                    float(counts[k]),
                    f"{low} to {high}",
                    shown=f"{counts[k]:.10g} counts",
                )


def refuse_pdos(bus: Bus, place: str) -> None:
    """Refuse PDOs that a drive or another node would misunderstand."""
    # A controlword on the identifier of another service would be a command of that
    # service, to every node.
    sync = bus.file.sync_can_id
    free = f"0x{FREE_CAN_IDS[0]:X} to 0x{FREE_CAN_IDS[-1]:X}"
    Location(place, "bus").require(
        sync == USUAL_SYNC or sync in FREE_CAN_IDS,
        "sync_can_id",
        sync,
        f"0x{USUAL_SYNC:X}, or {free}",
        shown=f"0x{sync:X}",
    )
    used = {sync: "SYNC"}
    ways = (
        (i, drive, way, pdos)
        for i, drive in enumerate(bus.drives)
        for way, pdos in (("tpdo", drive.tpdos), ("rpdo", drive.rpdos))
    )
    for i, drive, way, pdos in ways:
        for k, pdo in enumerate(pdos):
            at = Location(
                f"{place}: bus.drive[{i}]: {way} {pdo.number} (mapping = {drive.file.mapping!r})"
            )
            at.require(
                pdo.number not in [other.number for other in pdos[:k]],
                text=f"number = {pdo.number} is used twice",
                advice="Give each PDO its own number",
            )
            at.require(
                pdo.bits <= cia.MAX_PDO_BITS,
                text=f"the PDO has {pdo.length} bytes",
                expected="at most 8",
            )
            name = f"identifier 0x{pdo.can_id:03X}"
            at.require(
                cia.LOWEST_CAN_ID <= pdo.can_id <= cia.HIGHEST_CAN_ID or pdo.can_id in FREE_CAN_IDS,
                text=f"the {name} belongs to another service",
                expected=f"0x{cia.LOWEST_CAN_ID:X} to 0x{cia.HIGHEST_CAN_ID:X}, or {free}",
            )
            at.require(
                pdo.can_id not in used,
                text=f"the {name} is also that of {used.get(pdo.can_id)}",
                advice="Give each PDO its own identifier",
            )
            used[pdo.can_id] = f"a PDO of {drive.name}"


def refuse_counts(robot: Robot, i: int, file: DriveFile, at: Location) -> None:
    """Refuse counts per metre for a motor that turns, and counts per turn for one that slides."""
    # A torque or a force shows whether the motor turns or slides. For amperes or volts, the joints
    # that it moves show it.
    motor = robot.motors[i]
    unit = (motor.drive_gain_unit or motor.recorded_unit).partition("/")[0]
    slides = any(
        r and joint.type == "prismatic" for r, joint in zip(robot.R[i], robot.joints, strict=True)
    )
    metre, turn = file.counts_per_m, file.counts_per_turn
    if metre is not None and (unit == "N m" or (unit != "N" and not slides)):
        at.refuse(
            "counts_per_m",
            metre,
            text=f"motor {motor.name!r} "
            f"{'gives a torque' if unit == 'N m' else 'moves no prismatic joint'}",
            advice="Use counts_per_turn",
            shown=f"{metre:g}",
        )
    if turn is not None and unit == "N":
        at.refuse(
            "counts_per_turn",
            turn,
            text=f"motor {motor.name!r} gives a force",
            advice="Use counts_per_m",
            shown=f"{turn:g}",
        )


def axis_of(drive: Drive) -> int:
    """Return the offset of a drive's control and status objects from 6040h and 6041h.

    It is a multiple of 800h (CiA 402-2), the same for both.
    """
    axis = drive.control.index - cia.CONTROLWORD
    if (
        axis % AXIS
        or drive.status.index - cia.STATUSWORD != axis
        or drive.control.sub
        or drive.status.sub
    ):
        Location(f"node {drive.node}").refuse(
            text=f"control {drive.control} and status {drive.status} do not belong to one axis",
            advice="Use objects of one axis, such as 6040:0 and 6041:0",
        )
    return axis


def axis_index(drive: Drive, index: int) -> int:
    """Return the index of an object of CiA 402 for the axis of a drive.

    The control object of the drive need not be that of the standard.
    """
    return (index + drive.control.index - cia.CONTROLWORD) & 0xFFFF


def check_carriers(bus: Bus) -> None:
    """Refuse PDOs to the drives that lack an object that tracking needs, or that carry others:
    tracking would set these to 0.
    """
    for drive in bus.drives:
        at = Location(f"node {drive.node}")
        mode = f"{cia.MODE_OF_OPERATION + axis_of(drive):04X}:0"
        known = {str(drive.control), str(drive.target), mode}
        for entry, way, words in (
            (drive.control, "rpdo", "to the drive"),
            (drive.target, "rpdo", "to the drive"),
            (drive.status, "tpdo", "from the drive"),
        ):
            at.require(
                drive.carrier(entry, way) is not None,
                text=f"no PDO {words} carries {entry}, which tracking needs",
                advice="Map it",
            )
        for other in (str(e) for pdo in drive.rpdos for e in pdo.entries if str(e) not in known):
            at.refuse(
                text=f"a PDO to the drive carries {other}, which tracking would set to 0",
                advice=f"Map only {', '.join(sorted(known))}",
            )
