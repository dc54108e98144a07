"""The drives of a robot, resolved: `[bus]` and the object dictionaries into PDOs and codecs, or one line why not."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import AcquisitionError
from ..protocol import (
    BITS,
    EFFORT_OBJECTS,
    HIGHEST_CAN_ID,
    LOWEST_CAN_ID,
    RATED_CURRENT,
    RATED_TORQUE,
    RATED_UNITS,
    RULES,
    STANDARD,
    EffortCodec,
    ObjectDictionary,
    ObjectEntry,
    Pdo,
    PositionCodec,
    bus_load,
    load_dictionary,
    pdos_of,
    usual_can_id,
)
from .bus import BusFile, DriveFile, PdoFile, dictionary_label, parse_object
from .extra_objects import ExtraObject, extra_object
from .robot import Motor, Robot

LARGEST_LOAD = 0.95  # of the bus, with the worst case of bit stuffing
USUAL_SYNC = 0x80
FREE_CAN_IDS = range(0x680, 0x6E0)  # those that CiA 301 gives to no service, beside those of PDOs

POSITION_TYPE = "I32"  # of the position and of its target: codecs, and what is unwound of counters, go by it

Values = Mapping[tuple[int, int], int]
Entry = Callable[[str, str], ObjectEntry]  # key of the description and name of an object to what the drive has there


@dataclass(frozen=True, kw_only=True, eq=False)
class Drive:
    """A drive, ready to talk to.

    Attributes:
        effort: codec of what samples hold: the reference, or the actual value where no reference is described.
        rated: raw values that objects of the drive must have, by index.
        tpdos, rpdos: from the drive, to the drive.
        extras: further objects in the samples.
        dictionary: None where objects are written out.
        speed_limit, acceleration_limit: of the motor, counts/s and counts/s², by the limits of the joints that it moves;
            None where one of them states none.
    """

    name: str
    node: int
    status: ObjectEntry
    control: ObjectEntry
    position: ObjectEntry
    target: ObjectEntry
    position_codec: PositionCodec
    effort: EffortCodec
    rated: Mapping[int, int]
    tpdos: tuple[Pdo, ...]
    rpdos: tuple[Pdo, ...]
    extras: tuple[ExtraObject, ...]
    dictionary: ObjectDictionary | None
    speed_limit: float | None = None
    acceleration_limit: float | None = None

    def carrier(self, entry: ObjectEntry, direction: str) -> Pdo | None:
        """The PDO that carries an object."""
        pdos = self.tpdos if direction == "tpdo" else self.rpdos
        return next((pdo for pdo in pdos if pdo.offset(entry.index, entry.sub) is not None), None)


@dataclass(frozen=True, kw_only=True, eq=False)
class Bus:
    """The bus and its drives, in the order of the motors."""

    file: BusFile
    drives: tuple[Drive, ...]

    @property
    def period_ns(self) -> int:
        """From SYNC to SYNC."""
        return round(self.file.sync_period_s * 1e9)

    @property
    def load(self) -> float:
        """Share of the bus that SYNC and all PDOs take, with the worst case of bit stuffing."""
        pdos = [pdo for drive in self.drives for pdo in (*drive.tpdos, *drive.rpdos)]
        return bus_load(pdos, bitrate=self.file.bitrate, sync_period_s=self.file.sync_period_s)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was read with doubt in the drives' dictionaries."""
        dictionaries = [drive.dictionary for drive in self.drives if drive.dictionary is not None]
        return tuple(dict.fromkeys(text for dictionary in dictionaries for text in dictionary.warnings))

    @property
    def provenance(self) -> str:
        """Where efforts come from, drive by drive; drives alike are named together."""
        told: dict[str, list[str]] = {}
        for drive in self.drives:
            told.setdefault(drive.effort.provenance, []).append(drive.name)
        return "; ".join(f"{', '.join(names)}: {text}" for text, names in told.items())


def resolve(robot: Robot, place: str, traffic: Mapping[int, Values] | None = None) -> Bus:
    """The drives of `robot`; `traffic` holds what another master wrote, by node, for drives that are mapped by it.

    Raises `AcquisitionError` naming `place`, the key, the value and what was expected.
    """
    if robot.bus is None:
        raise AcquisitionError(f"{place}: bus is not there: expected a [bus] section with one drive per motor")
    drives = tuple(
        _drive(file, motor, robot.files, f"{place}: bus.drive[{i}]", traffic)
        for i, (file, motor) in enumerate(zip(robot.bus.drive, robot.motors, strict=True))
    )
    bus = Bus(file=robot.bus, drives=tuple(_with_limits(drive, robot, i) for i, drive in enumerate(drives)))
    _refuse_pdos(bus, place)
    for i in range(robot.n):
        _refuse_counts(robot, i, robot.bus.drive[i], f"{place}: bus.drive[{i}]")
    return bus


def refuse_load(bus: Bus, place: str) -> None:
    """Refuse PDOs in both directions that do not fit between two SYNCs; for sessions that send, not for listeners."""
    if bus.load > LARGEST_LOAD:
        fastest_s = bus.load * bus.file.sync_period_s / LARGEST_LOAD
        raise AcquisitionError(
            f"{place}: bus.sync_period_s = {bus.file.sync_period_s:g}: {bus.load:.0%} of {bus.file.bitrate} bit/s: "
            f"expected {LARGEST_LOAD:.0%} at most: {fastest_s:.2g} s or longer, or fewer PDOs"
        )


def refuse_out_of_range(path: NDArray[np.float64], robot: Robot, bus: Bus, place: str) -> None:
    """Refuse joint positions (N, n), one row each SYNC, whose counts are more than a drive's target object can hold.

    A drive held at the end of its counts would stand still while the others go on. Raises `AcquisitionError` naming
    `place`, the time, the motor, its counts and the range; also where a position is not finite.
    """
    low, high = -(2 ** (BITS[POSITION_TYPE] - 1)), 2 ** (BITS[POSITION_TYPE] - 1) - 1
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused below
        motors = robot.motor_position(path)
        for i, drive in enumerate(bus.drives):
            counts = drive.position_codec.exact(motors[:, i])
            good = (np.rint(counts) >= low) & (np.rint(counts) <= high)  # NaN is neither
            if not good.all():
                k = int(np.argmin(good))
                raise AcquisitionError(
                    f"{place}: at {k * bus.file.sync_period_s:.4g} s: target of node {drive.node} ({drive.name}) = "
                    f"{counts[k]:.10g} counts: expected {low} to {high}"
                )


def _with_limits(drive: Drive, robot: Robot, i: int) -> Drive:
    """The limits of the joints that motor `i` moves, at the motor: they add up at worst."""

    def limit(quantity: str) -> float | None:
        moved = [(abs(r), joint.si(quantity)) for r, joint in zip(robot.R[i], robot.joints, strict=True) if r]
        if any(value is None for _, value in moved):
            return None
        return float(sum(r * value for r, value in moved) * drive.position_codec.counts_per_unit)

    return replace(drive, speed_limit=limit("speed"), acceleration_limit=limit("acceleration"))


def _refuse_pdos(bus: Bus, place: str) -> None:
    """Refuse what a drive or another node would misunderstand, whichever source the PDOs have.

    A controlword on the identifier of another service would be a command of that service, to every node.
    """
    sync = bus.file.sync_can_id
    free = f"0x{FREE_CAN_IDS[0]:X} to 0x{FREE_CAN_IDS[-1]:X}"
    if sync != USUAL_SYNC and sync not in FREE_CAN_IDS:
        raise AcquisitionError(f"{place}: bus.sync_can_id = 0x{sync:X}: expected 0x{USUAL_SYNC:X}, or {free}")
    used = {sync: "SYNC"}
    for i, (file, drive) in enumerate(zip(bus.file.drive, bus.drives, strict=True)):
        for way, pdos in (("tpdo", drive.tpdos), ("rpdo", drive.rpdos)):
            numbers: set[int] = set()
            for pdo in pdos:
                key = f"{place}: bus.drive[{i}]: {way} {pdo.number} (mapping = {file.mapping!r})"
                if pdo.number in numbers:
                    raise AcquisitionError(f"{key}: number = {pdo.number} is there twice: expected one of its own")
                numbers.add(pdo.number)
                if pdo.bits > 64:
                    raise AcquisitionError(f"{key}: {pdo.length} bytes: expected 8 at most")
                if not LOWEST_CAN_ID <= pdo.can_id <= HIGHEST_CAN_ID and pdo.can_id not in FREE_CAN_IDS:
                    expected = f"0x{LOWEST_CAN_ID:X} to 0x{HIGHEST_CAN_ID:X}, or {free}"
                    raise AcquisitionError(f"{key}: identifier 0x{pdo.can_id:03X}: expected {expected}")
                if pdo.can_id in used:
                    told = f"identifier 0x{pdo.can_id:03X} is that of {used[pdo.can_id]}"
                    raise AcquisitionError(f"{key}: {told}: expected one of its own")
                used[pdo.can_id] = f"a PDO of {drive.name}"


def _refuse_counts(robot: Robot, i: int, file: DriveFile, place: str) -> None:
    """Refuse counts per metre of a motor that turns, and per turn of one that slides.

    A torque or a force tells which; where efforts are amperes or volts alone, the joints that the motor moves do.
    """
    motor = robot.motors[i]
    unit = (motor.drive_gain_unit or motor.recorded_unit).partition("/")[0]
    slides = any(r and joint.type == "prismatic" for r, joint in zip(robot.R[i], robot.joints, strict=True))
    if file.counts_per_m is not None and (unit == "N m" or (unit != "N" and not slides)):
        why = "gives a torque" if unit == "N m" else "moves no prismatic joint"
        told = f"{place}.counts_per_m = {file.counts_per_m:g}: motor {motor.name!r} {why}"
        raise AcquisitionError(f"{told}: expected counts_per_turn")
    if file.counts_per_turn is not None and unit == "N":
        told = f"{place}.counts_per_turn = {file.counts_per_turn:g}: motor {motor.name!r} gives a force"
        raise AcquisitionError(f"{told}: expected counts_per_m")


def _drive(
    file: DriveFile,
    motor: Motor,
    files: Mapping[str, bytes],
    place: str,
    traffic: Mapping[int, Values] | None,
) -> Drive:
    dictionary, types = None, dict(STANDARD)
    if file.dictionary is not None:
        label = dictionary_label(file.dictionary)
        if label not in files:
            raise AcquisitionError(f"{place}.dictionary = {file.dictionary!r}: is missing beside the description")
        dictionary = load_dictionary(files[label], file.dictionary, file.node)
        types |= {key: entry.type for key, entry in dictionary.entries.items() if entry.type}
    types |= {parse_object(name): kind for name, kind in file.objects.items()}
    written = {parse_object(name) for name in file.objects}

    def entry(key: str, name: str) -> ObjectEntry:
        index, sub = parse_object(name)
        known = written if dictionary is None else written | set(dictionary.entries)
        if (index, sub) not in types or (dictionary is not None and (index, sub) not in known):
            where = f"{file.dictionary} holds it not" if dictionary else "its type is not known"
            raise AcquisitionError(
                f"{place}.{key} = {name!r}: {where}: expected an object of the drive, or one in objects"
            )
        return ObjectEntry(index=index, sub=sub, type=types[index, sub])

    word = "reference" if file.reference is not None else "actual"
    effort = _effort(file, word, entry(word, getattr(file, word) or ""), motor, place)
    status, control = entry("status", file.status), entry("control", file.control)
    position, target = entry("position", file.position), entry("target", file.target)
    for key, found in (("position", position), ("target", target)):
        if found.type != POSITION_TYPE:
            raise AcquisitionError(f"{place}.{key} = {getattr(file, key)!r}: is {found.type}: expected {POSITION_TYPE}")
    extras = tuple(
        extra_object(e, entry(f"extra[{k}]", e if isinstance(e, str) else e.object), file, motor, place)
        for k, e in enumerate(file.extra)
    )
    if file.mapping == "table":
        measured = dict.fromkeys((status, position, effort.entry, *(extra.entry for extra in extras)))
        default = {"tpdo": tuple(measured), "rpdo": (control, target)}
        pdos = {way: _pdos(way, getattr(file, way), default[way], file.node, entry, place) for way in default}
    else:
        source: Values = {}
        if file.mapping == "dictionary" and dictionary is not None:
            source = {key: e.value for key, e in dictionary.entries.items() if e.value is not None}
        elif traffic is not None:
            source = traffic.get(file.node, {})
        pdos = {way: pdos_of(way, source, types, f"{place}.mapping") for way in ("tpdo", "rpdo")}
    drive = Drive(
        name=motor.name,
        node=file.node,
        status=status,
        control=control,
        position=position,
        target=target,
        position_codec=PositionCodec(
            counts_per_unit=file.counts_per_m or (file.counts_per_turn or 0.0) / (2 * np.pi),
            sign=file.sign,
            zero_counts=file.zero_counts,
        ),
        effort=effort,
        rated=_rated(file),
        tpdos=pdos["tpdo"],
        rpdos=pdos["rpdo"],
        extras=extras,
        dictionary=dictionary,
    )
    for needed in (position, effort.entry, *(extra.entry for extra in extras)):
        if (traffic is not None or file.mapping != "traffic") and drive.carrier(needed, "tpdo") is None:
            raise AcquisitionError(
                f"{place}.mapping: no PDO from the drive carries {needed}: expected one ({file.mapping})"
            )
    return drive


def _pdos(
    way: str, files: tuple[PdoFile, ...], default: tuple[ObjectEntry, ...], node: int, entry: Entry, place: str
) -> tuple[Pdo, ...]:
    found = []
    wanted: list[tuple[PdoFile | None, tuple[ObjectEntry, ...]]] = [(None, part) for part in _packed(default)]
    if files:
        wanted = [
            (file, tuple(entry(f"{way}[{k}].objects", name) for name in file.objects)) for k, file in enumerate(files)
        ]
    for k, (written, entries) in enumerate(wanted):
        key = f"{place}.{way}[{k}]"
        number = (written.number if written else None) or k + 1
        can_id = (written.can_id if written else None) or usual_can_id(way, number, node)
        if can_id is None:
            raise AcquisitionError(
                f"{key}.can_id is not there: expected one: only the first four PDOs have a usual one"
            )
        pdo = Pdo(number=number, can_id=can_id, entries=entries)
        if pdo.bits > 64:
            told = " + ".join(str(e.bits // 8) for e in entries)
            raise AcquisitionError(f"{key}.objects: {told} = {pdo.length} bytes: expected 8 at most; use a second PDO")
        found.append(pdo)
    return tuple(found)


def _packed(entries: tuple[ObjectEntry, ...]) -> list[tuple[ObjectEntry, ...]]:
    """Entries in as few PDOs as their order allows."""
    parts: list[tuple[ObjectEntry, ...]] = [()]
    for entry in entries:
        if sum(e.bits for e in parts[-1]) + entry.bits > 64:
            parts.append(())
        parts[-1] += (entry,)
    return parts


def _effort(file: DriveFile, word: str, entry: ObjectEntry, motor: Motor, place: str) -> EffortCodec:
    known = EFFORT_OBJECTS.get((entry.index, entry.sub))
    name = getattr(file, f"{word}_rule")
    if name is None:
        if known is None or known.entry.type != entry.type:
            told = f"{place}.{word}_rule is not there: {entry} ({entry.type}) is not known"
            raise AcquisitionError(f"{told}: expected one of {', '.join(RULES)}")
        name = known.rule
    rule = RULES[name]
    rated = getattr(file, rule.rated) if rule.rated else 1.0
    if rated is None:
        raise AcquisitionError(f"{place}.{rule.rated} is not there: expected the rated value that {name!r} multiplies")
    if rule.unit != motor.recorded_unit:
        raise AcquisitionError(
            f"{place}.{word}_rule = {name!r}: gives {rule.unit}: expected {motor.recorded_unit} as motor {motor.name!r} says"
        )
    meaning = known.meaning if known is not None and known.entry.type == entry.type else "as described"
    stands_in = "" if word == "reference" else ", the actual value standing in for the reference"
    times = f" x {rated:g} ({rule.rated})" if rule.rated else ""
    sign = file.effort_sign or file.sign
    return EffortCodec(
        entry=entry,
        rule=rule,
        rated=rated,
        sign=sign,
        provenance=f"object {entry} ({meaning}){stands_in}, raw {entry.type} in {name}{times}, sign {sign:+d}",
    )


def _rated(file: DriveFile) -> dict[int, int]:
    found = {}
    if file.rated_current_a is not None:
        found[RATED_CURRENT] = round(file.rated_current_a / RATED_UNITS[file.rated_current_unit])
    torque = file.rated_torque_nm if file.rated_torque_nm is not None else file.rated_force_n
    if torque is not None:
        found[RATED_TORQUE] = round(torque / RATED_UNITS[file.rated_torque_unit])
    return found
