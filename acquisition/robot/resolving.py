"""Resolving of `[bus]` and the object dictionaries into PDOs and codecs of every drive.

The objects of a drive are raw integers, while robot.toml describes joints in degrees and metres.
Three sources define an object, each more exactly than the one before:

    CiA 301 and 402     types of the usual objects, usual identifiers of the PDOs
    dictionary (EDS)    types of all objects of the drive; a DCF also the PDOs that it has
    robot.toml          the objects that are used, with types of its own; rated values, counts,
                        signs

- **Objects**: if a drive has a dictionary, an object that is neither in it nor in robot.toml is
  refused, even a usual one. Without its type it cannot be extracted from a frame.
- **PDOs** are those of `mapping`. "table": the PDOs in robot.toml, or as few as possible.
  "dictionary": those in the values of the DCF. "traffic": those that the drive confirmed to another
  master; a session does not see these, and has none. A PDO from the drive must carry each object of
  a sample.
- **Codecs**: the effort is raw integer x rule x rated value x sign, in the unit of the motor; the
  position is (counts - zero) x sign / counts per radian or metre.
- **Limits** of the joints apply to the motors too: a row of the motor matrix R adds the speeds of
  the joints that the motor moves, and its extreme positions are at a corner of their ranges.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from .. import protocol as cia
from ..errors import Location
from .bus import DriveFile, PdoFile, dictionary_label, parse_object
from .description import Motor
from .drives import POSITION_TYPE, Bus, Drive, Motion, refuse_counts, refuse_pdos
from .robot import Robot


def resolve(robot: Robot, place: str, traffic: Mapping[int, cia.Confirmed] | None = None) -> Bus:
    """Resolve the drives of a robot, with their PDOs and codecs.

    Parameters
    ----------
    robot : the robot, with `[bus]`.
    place : name of the description in errors.
    traffic : what the drives of a log confirmed, by node. It gives the PDOs of drives with `mapping
        = "traffic"`, and warnings where another mapping differs from it.

    Raises
    ------
    BadInputError : there is no `[bus]`, an object is unknown, or PDOs do not fit.
    """
    written = Location(place).given(
        robot.bus,
        "bus",
        None,
        advice="Describe the drives: remove `#: ` in robot.toml, or run "
        "`robot-identify init --bus`",
    )
    seen = traffic or {}
    drives = tuple(
        _drive(robot, i, file, place, seen.get(file.node)) for i, file in enumerate(written.drive)
    )
    contradictions = tuple(
        f"bus.drive[{i}]: {drive.name} confirmed {index:04X}:{sub} = 0x{number:X}, which is not "
        f"{way} {pdo.number} (0x{pdo.can_id:X}) by mapping = {drive.file.mapping!r}: "
        "correct it"
        for i, drive in enumerate(drives)
        if drive.node in seen
        for way, pdos in (("tpdo", drive.tpdos), ("rpdo", drive.rpdos))
        for pdo in pdos
        for (index, sub), number in cia.contradicted(way, pdo, seen[drive.node].values)
    )
    bus = Bus(file=written, drives=drives, notes=contradictions)
    refuse_pdos(bus, place)
    for i, file in enumerate(written.drive):
        refuse_counts(robot, i, file, Location(place, f"bus.drive[{i}]"))
    return bus


def _limit(robot: Robot, i: int, quantity: str) -> float | None:
    """Return the limit of a motor, the sum over the joints that it moves.

    The result is None if one of them has no limit.
    """
    ratios = [abs(r) for r in robot.R[i]]
    limits = [x.si(quantity) if r else 0.0 for r, x in zip(ratios, robot.joints, strict=True)]
    return (
        None
        if None in limits
        else float(sum(r * limit for r, limit in zip(ratios, limits, strict=True)))
    )


def _position_range(robot: Robot, i: int, codec: cia.PositionCodec) -> tuple[float, float] | None:
    """Return the lowest and highest counts of a motor within limits of position.

    The limits are those of the joints that the motor moves. The result is None if one of them has
    no limits.
    """
    limits = [
        joint.si("position") if r else (0.0, 0.0)
        for r, joint in zip(robot.R[i], robot.joints, strict=True)
    ]
    if None in limits:
        return None
    low, high = np.array(limits).T
    corners = np.where(robot.R[i] > 0, [low, high], [high, low])
    lowest, highest = sorted(codec.exact(robot.motor_position(corners)[:, i]).tolist())
    return lowest, highest


@dataclass(frozen=True, kw_only=True)
class _Objects:
    """The objects of a drive.

    Attributes:
        types: their types.
        usable: those that robot.toml may name.
        at: table of the drive, for errors.
    """

    file: DriveFile
    dictionary: cia.ObjectDictionary | None
    types: Mapping[cia.Key, str]
    usable: Collection[cia.Key]
    at: Location

    def entry(self, key: str, name: str) -> cia.ObjectEntry:
        """Return the object with this name, which a key of the table gives."""
        number = parse_object(name)
        if number not in self.usable:
            why = "its type is not known"
            if self.dictionary is not None:
                absent = cia.DictionaryEntry(problem=f"{self.file.dictionary} does not contain it")
                why = self.dictionary.entries.get(number, absent).problem or why
            self.at.refuse(
                key, name, text=why, advice="Name an object of the drive, or add it to objects"
            )
        return cia.ObjectEntry(index=number[0], sub=number[1], type=self.types[number])


def _objects(robot: Robot, file: DriveFile, at: Location) -> _Objects:
    stated = {parse_object(name): kind for name, kind in file.objects.items()}
    types = cia.STANDARD | stated
    if file.dictionary is None:
        return _Objects(file=file, dictionary=None, types=types, usable=types, at=at)
    content = at.given(
        robot.files.get(dictionary_label(file.dictionary)),
        "dictionary",
        file.dictionary,
        text="the file is missing beside robot.toml",
    )
    dictionary = cia.load_dictionary(content, file.dictionary, file.node)
    types = cia.STANDARD | {k: e.type for k, e in dictionary.entries.items() if e.type} | stated
    usable = types.keys() & (dictionary.entries.keys() | stated.keys())
    return _Objects(file=file, dictionary=dictionary, types=types, usable=usable, at=at)


def _drive(
    robot: Robot, i: int, file: DriveFile, place: str, confirmed: cia.Confirmed | None
) -> Drive:
    at = Location(place, f"bus.drive[{i}]")
    objects = _objects(robot, file, at)

    # Find the objects that robot.toml names.
    word = "reference" if file.reference is not None else "actual"
    effort = _effort(file, word, objects.entry(word, getattr(file, word)), robot.motors[i], at)
    status, control, position, target = (
        objects.entry(key, getattr(file, key))
        for key in ("status", "control", "position", "target")
    )
    for key, found in (("position", position), ("target", target)):
        at.require(
            found.type == POSITION_TYPE,
            key,
            getattr(file, key),
            POSITION_TYPE,
            text=f"its type is {found.type}",
        )
    extras = tuple(objects.entry(f"extra[{k}]", name) for k, name in enumerate(file.extra_objects))
    measured = tuple(dict.fromkeys((position, effort.entry, *extras)))

    # Build the PDOs that carry them, and the codecs.
    mapped = _mapped(objects, confirmed)
    codec = cia.PositionCodec(
        counts_per_unit=file.counts_per_unit, sign=file.sign, zero_counts=file.zero_counts
    )
    drive = Drive(
        file=file,
        name=robot.motors[i].name,
        status=status,
        control=control,
        position=position,
        target=target,
        position_codec=codec,
        effort=effort,
        tpdos=_pdos("tpdo", objects, mapped, tuple(dict.fromkeys((status, *measured)))),
        rpdos=_pdos("rpdo", objects, mapped, (control, target)),
        extras=extras,
        dictionary=objects.dictionary,
        types=objects.types,
        motion=_motion(robot, i, file, codec),
    )

    # Each object of a sample needs a PDO from the drive.
    absent = [entry for entry in measured if drive.carrier(entry, "tpdo") is None]
    # The mapping of another master is only visible in its traffic, so a session cannot check it.
    if absent and (confirmed is not None or file.mapping != "traffic"):
        reasons = [
            f": {index:04X}:{sub} {text}"
            for (index, sub), text in mapped.items()
            if isinstance(text, str) and 0x1800 <= index < 0x1C00
        ] + [f": {confirmed.refused}" if confirmed and confirmed.refused else ""]
        at.refuse(
            "mapping",
            file.mapping,
            text=f"no PDO from the drive carries {absent[0]}{reasons[0]}",
            advice="Map it",
        )
    return drive


def _mapped(objects: _Objects, confirmed: cia.Confirmed | None) -> cia.Values:
    """Return the parameters of PDOs from the source that `mapping` names; none for a table."""
    if objects.file.mapping == "traffic" and confirmed is not None:
        return confirmed.values
    if objects.file.mapping != "dictionary" or objects.dictionary is None:
        return {}
    read = ((key, e.problem or e.value) for key, e in objects.dictionary.entries.items())
    return {key: value for key, value in read if value is not None}


def _motion(robot: Robot, i: int, file: DriveFile, codec: cia.PositionCodec) -> Motion:
    """Return the limits of the joints that motor `i` moves, at the motor."""
    ratios = np.abs(robot.R[i])
    per_joint = float(ratios.sum() * file.counts_per_unit)
    slides = robot.joints[int(np.argmax(ratios))].type == "prismatic"
    speed, acceleration = (_limit(robot, i, quantity) for quantity in ("speed", "acceleration"))
    return Motion(
        speed=None if speed is None else speed * file.counts_per_unit,
        acceleration=None if acceleration is None else acceleration * file.counts_per_unit,
        position=_position_range(robot, i, codec),
        rpm=None if speed is None or not file.counts_per_turn else 30 / np.pi * speed,
        counts_per_joint=(per_joint, "m") if slides else (per_joint * np.pi / 180, "deg"),
        ratio=float(ratios.max()) if np.count_nonzero(ratios) == 1 else None,
    )


def _pdos(
    way: str, objects: _Objects, mapped: cia.Values, default: tuple[cia.ObjectEntry, ...]
) -> tuple[cia.Pdo, ...]:
    """Return the PDOs of one direction.

    They are as `mapped`, as given in robot.toml, or as few as possible with the `default` objects
    in order.
    """
    pdos, at = [], objects.at
    if objects.file.mapping != "table":
        return cia.pdos_of(way, mapped, objects.types, f"{at}: {at.table}.mapping")
    for k, written in enumerate(getattr(objects.file, way) or _pack(default)):
        entries = tuple(objects.entry(f"{way}[{k}].objects", name) for name in written.objects)
        number = written.number or k + 1
        can_id = at.given(
            written.can_id or cia.usual_can_id(way, number, objects.file.node),
            f"{way}[{k}].can_id",
            None,
            text="only the first four PDOs have a usual identifier",
            advice="Give an identifier",
        )
        pdos.append(cia.Pdo(number=number, can_id=can_id, entries=entries))
        at.require(
            pdos[-1].bits <= cia.MAX_PDO_BITS,
            f"{way}[{k}].objects",
            text=f"they take {' + '.join(str(e.bits // 8) for e in entries)} = "
            f"{pdos[-1].length} bytes, more than 8",
            advice="Use a second PDO",
        )
    return tuple(pdos)


def _pack(entries: tuple[cia.ObjectEntry, ...]) -> tuple[PdoFile, ...]:
    parts: list[tuple[cia.ObjectEntry, ...]] = [()]
    for entry in entries:
        if sum(e.bits for e in parts[-1]) + entry.bits > cia.MAX_PDO_BITS:
            parts.append(())
        parts[-1] += (entry,)
    return tuple(PdoFile(objects=tuple(map(str, part))) for part in parts)


def _effort(
    file: DriveFile, word: str, entry: cia.ObjectEntry, motor: Motor, at: Location
) -> cia.EffortCodec:
    kind, usual, meaning = cia.EFFORT_OBJECTS.get(entry.key, ("", "", ""))
    known = kind == entry.type
    name: str = at.given(
        getattr(file, f"{word}_rule") or (usual if known else None),
        f"{word}_rule",
        None,
        f"one of {', '.join(cia.RULES)}",
        text=f"the unit of {entry} ({entry.type}) is unknown",
    )
    rule = cia.RULES[name]
    rated: float = at.given(
        getattr(file, rule.rated) if rule.rated else 1.0,
        rule.rated,
        None,
        advice=f"Give the rated value that {name!r} multiplies",
    )
    sign = file.effort_sign or file.sign
    at.require(
        rule.unit == motor.recorded_unit,
        f"{word}_rule",
        name,
        text=f"it gives {rule.unit}, but motor {motor.name!r} has {motor.recorded_unit}",
        advice=f"Correct it, or set effort_unit = {rule.unit!r}",
    )
    return cia.EffortCodec(
        entry=entry,
        scale=float(sign * rule.factor * rated),
        provenance=f"object {entry} ({meaning if known else 'as described'})"
        f"{'' if word == 'reference' else ', the actual value instead of the reference'}"
        f", raw {entry.type} in {name}{f' x {rated:g} ({rule.rated})' if rule.rated else ''}"
        f", sign {sign:+d}",
    )
