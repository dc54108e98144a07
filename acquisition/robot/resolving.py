"""Resolves `[bus]` and the object dictionaries to PDOs and codecs of every drive."""

from collections.abc import Callable, Mapping

import numpy as np

from .. import protocol as cia
from ..errors import Place
from .bus import DriveFile, PdoFile, dictionary_label, parse_object
from .description import Motor
from .drives import POSITION_TYPE, Bus, Drive, refuse_counts, refuse_pdos
from .robot import Robot


def resolve(robot: Robot, place: str, traffic: Mapping[int, cia.Confirmed] | None = None) -> Bus:
    """The drives of `robot` with their PDOs and codecs.

    `traffic` is what the drives of a log confirmed, by node: for drives with `mapping = "traffic"`,
    and for a warning where another mapping is not that.
    """
    if robot.bus is None:
        Place(place).refuse("bus", None, "its drives: remove `#: ` in robot.toml, or `init --bus`")
    seen = traffic or {}
    drives = tuple(
        _drive(robot, i, file, place, seen.get(file.node)) for i, file in enumerate(robot.bus.drive)
    )
    contradictions = tuple(
        f"bus.drive[{i}]: {drive.name} confirmed {index:04X}:{sub} = 0x{number:X}, which is not "
        f"{way} {pdo.number} (0x{pdo.can_id:X}) by mapping = {robot.bus.drive[i].mapping!r}: "
        "correct it"
        for i, drive in enumerate(drives)
        if drive.node in seen
        for way, pdos in (("tpdo", drive.tpdos), ("rpdo", drive.rpdos))
        for pdo in pdos
        for (index, sub), number in cia.contradicted(way, pdo, seen[drive.node].values)
    )
    bus = Bus(file=robot.bus, drives=drives, notes=contradictions)
    refuse_pdos(bus, place)
    for i, file in enumerate(robot.bus.drive):
        refuse_counts(robot, i, file, Place(place, f"bus.drive[{i}]"))
    return bus


def _limit(robot: Robot, i: int, quantity: str) -> float | None:
    """The limit of a motor: the sum over the joints that it moves; None if
    one of them states none.
    """
    moved = [
        (abs(r), joint.si(quantity)) for r, joint in zip(robot.R[i], robot.joints, strict=True) if r
    ]
    if any(value is None for _, value in moved):
        return None
    return float(sum(r * value for r, value in moved))


def _position_range(robot: Robot, i: int, codec: cia.PositionCodec) -> tuple[float, float] | None:
    """Lowest and highest counts of a motor within the position limits of the joints that it
    moves; None if one of them states none.
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


def _drive(
    robot: Robot, i: int, file: DriveFile, place: str, confirmed: cia.Confirmed | None
) -> Drive:
    motor, files, at = robot.motors[i], robot.files, Place(place, f"bus.drive[{i}]")
    dictionary, types = None, dict(cia.STANDARD)
    if file.dictionary is not None:
        label = dictionary_label(file.dictionary)
        if label not in files:
            at.refuse("dictionary", file.dictionary, text="is missing next to the description")
        dictionary = cia.load_dictionary(files[label], file.dictionary, file.node)
        types |= {key: entry.type for key, entry in dictionary.entries.items() if entry.type}
    written = {parse_object(name): kind for name, kind in file.objects.items()}
    types |= written

    def entry(key: str, name: str) -> cia.ObjectEntry:
        number = parse_object(name)
        listed = dictionary is None or number in dictionary.entries or number in written
        if number not in types or not listed:
            found = dictionary.entries.get(number) if dictionary is not None else None
            why = (found and found.problem) or "its type is not known"
            why = why if found or dictionary is None else f"{file.dictionary} does not contain it"
            at.refuse(key, name, "an object of the drive, or one in objects", text=why)
        return cia.ObjectEntry(index=number[0], sub=number[1], type=types[number])

    word = "reference" if file.reference is not None else "actual"
    effort = _effort(file, word, entry(word, getattr(file, word)), motor, at)
    status, control = entry("status", file.status), entry("control", file.control)
    position, target = entry("position", file.position), entry("target", file.target)
    for key, found in (("position", position), ("target", target)):
        if found.type != POSITION_TYPE:
            at.refuse(key, getattr(file, key), POSITION_TYPE, text=f"is {found.type}")
    extras = tuple(entry(f"extra[{k}]", name) for k, name in enumerate(file.extra_objects))
    measured = tuple(dict.fromkeys((position, effort.entry, *extras)))
    source = confirmed.values if confirmed is not None and file.mapping == "traffic" else {}
    if file.mapping == "table":
        tpdos = _pdos("tpdo", file, tuple(dict.fromkeys((status, *measured))), entry, at)
        rpdos = _pdos("rpdo", file, (control, target), entry, at)
    else:
        if file.mapping == "dictionary" and dictionary is not None:
            read = ((key, e.problem or e.value) for key, e in dictionary.entries.items())
            source = {key: value for key, value in read if value is not None}
        tpdos, rpdos = (
            cia.pdos_of(way, source, types, f"{at}: {at.table}.mapping") for way in ("tpdo", "rpdo")
        )
    codec = cia.PositionCodec(
        counts_per_unit=file.counts_per_unit, sign=file.sign, zero_counts=file.zero_counts
    )
    speed, acceleration = (_limit(robot, i, quantity) for quantity in ("speed", "acceleration"))
    slides = robot.joints[int(np.argmax(np.abs(robot.R[i])))].type == "prismatic"
    per_joint = float(np.abs(robot.R[i]).sum() * file.counts_per_unit)
    drive = Drive(
        name=motor.name,
        node=file.node,
        status=status,
        control=control,
        position=position,
        target=target,
        position_codec=codec,
        effort=effort,
        rated=_rated_values(file),
        tpdos=tpdos,
        rpdos=rpdos,
        extras=extras,
        dictionary=dictionary,
        types=types,
        speed_limit=None if speed is None else speed * file.counts_per_unit,
        acceleration_limit=None if acceleration is None else acceleration * file.counts_per_unit,
        counts_per_joint=(per_joint, "m") if slides else (per_joint * np.pi / 180, "deg"),
        position_range=_position_range(robot, i, codec),
        rpm_limit=None if speed is None or not file.counts_per_turn else 30 / np.pi * speed,
        ratio=float(np.abs(robot.R[i]).max()) if np.count_nonzero(robot.R[i]) == 1 else None,
    )
    for needed in measured:
        unmapped = confirmed is None and file.mapping == "traffic"  # that is seen in a log
        if not unmapped and drive.carrier(needed, "tpdo") is None:
            unknown = [
                f": {index:04X}:{sub} {text}"
                for (index, sub), text in source.items()
                if isinstance(text, str) and 0x1800 <= index < 0x1C00
            ]
            refused = confirmed.refused if confirmed is not None else ""
            why = next(iter(unknown), refused and f": {refused}")
            problem = f"{at.table}.mapping: no PDO from the drive carries {needed}{why}"
            Place(at.name).refuse(text=problem, expected=f"one ({file.mapping})")
    return drive


def _pdos(
    way: str,
    file: DriveFile,
    default: tuple[cia.ObjectEntry, ...],
    entry: Callable[[str, str], cia.ObjectEntry],
    at: Place,
) -> tuple[cia.Pdo, ...]:
    """The PDOs of one direction, as described, else as few as possible with the `default` objects
    in order; `entry` makes one of a key of the description and an object's name.
    """
    pdos = []
    files: tuple[PdoFile, ...] = getattr(file, way) or _pack(default)
    for k, written in enumerate(files):
        entries = tuple(entry(f"{way}[{k}].objects", name) for name in written.objects)
        number = written.number or k + 1
        can_id = written.can_id or cia.usual_can_id(way, number, file.node)
        if can_id is None:
            at.refuse(
                f"{way}[{k}].can_id",
                None,
                "an identifier: only the first four PDOs have a usual one",
            )
        pdo = cia.Pdo(number=number, can_id=can_id, entries=entries)
        if pdo.bits > cia.MAX_PDO_BITS:
            sizes = " + ".join(str(e.bits // 8) for e in entries)
            at.refuse(
                f"{way}[{k}].objects",
                text=f"{sizes} = {pdo.length} bytes",
                expected="8 at most; use a second PDO",
            )
        pdos.append(pdo)
    return tuple(pdos)


def _pack(entries: tuple[cia.ObjectEntry, ...]) -> tuple[PdoFile, ...]:
    parts: list[tuple[cia.ObjectEntry, ...]] = [()]
    for entry in entries:
        if sum(e.bits for e in parts[-1]) + entry.bits > cia.MAX_PDO_BITS:
            parts.append(())
        parts[-1] += (entry,)
    return tuple(PdoFile(objects=tuple(map(str, part))) for part in parts)


def _effort(
    file: DriveFile, word: str, entry: cia.ObjectEntry, motor: Motor, at: Place
) -> cia.EffortCodec:
    kind, usual, meaning = cia.EFFORT_OBJECTS.get(entry.key, ("", "", ""))
    known = kind == entry.type
    name = getattr(file, f"{word}_rule") or (usual if known else None)
    if name is None:
        at.refuse(
            f"{word}_rule",
            None,
            f"one of {', '.join(cia.RULES)}",
            text=f"{entry} ({entry.type}) is not known",
        )
    rule = cia.RULES[name]
    rated = getattr(file, rule.rated) if rule.rated else 1.0
    if rated is None:
        at.refuse(rule.rated, None, f"the rated value that {name!r} multiplies")
    scale = float((file.effort_sign or file.sign) * rule.factor * rated)
    if rule.unit != motor.recorded_unit:
        at.refuse(
            f"{word}_rule",
            name,
            f"{motor.recorded_unit} as motor {motor.name!r} says, or {rule.unit} as effort_unit",
            text=f"gives {rule.unit}",
        )
    times = f" x {rated:g} ({rule.rated})" if rule.rated else ""
    parts = (
        f"object {entry} ({meaning if known else 'as described'})",
        *(() if word == "reference" else ("the actual value instead of the reference",)),
        f"raw {entry.type} in {name}{times}",
        f"sign {file.effort_sign or file.sign:+d}",
    )
    return cia.EffortCodec(entry=entry, scale=scale, provenance=", ".join(parts))


def _rated_values(file: DriveFile) -> dict[int, int]:
    torque = file.rated_torque_nm if file.rated_torque_nm is not None else file.rated_force_n
    rated = {
        cia.RATED_CURRENT: (file.rated_current_a, file.rated_current_unit),
        cia.RATED_TORQUE: (torque, file.rated_torque_unit),
    }
    return {
        index: round(value / cia.RATED_UNITS[unit])
        for index, (value, unit) in rated.items()
        if value is not None
    }
