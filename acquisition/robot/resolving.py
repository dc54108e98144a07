"""`[bus]` and the object dictionaries into PDOs and codecs of every drive, or one line why not."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from ..errors import AcquisitionError
from ..protocol import (
    EFFORT_OBJECTS,
    RATED_CURRENT,
    RATED_TORQUE,
    RATED_UNITS,
    RULES,
    STANDARD,
    EffortCodec,
    ObjectEntry,
    Pdo,
    PositionCodec,
    load_dictionary,
    pdos_of,
    usual_can_id,
)
from .bus import DriveFile, PdoFile, dictionary_label, parse_object
from .description import Motor
from .drives import POSITION_TYPE, Bus, Drive, Values, refuse_counts, refuse_pdos
from .extra_objects import extra_object
from .robot import Robot

Entry = Callable[[str, str], ObjectEntry]  # key of the description and name of an object to what the drive has there


def resolve(robot: Robot, place: str, traffic: Mapping[int, Values] | None = None) -> Bus:
    """The drives of `robot` with their PDOs and codecs.

    `traffic` are values that another master wrote, by node and (index, sub), for drives with `mapping = "traffic"`. Raises
    `AcquisitionError` that names `place`, the key, the value and what was expected.
    """
    if robot.bus is None:
        raise AcquisitionError(place=place, key="bus", value=None, expected="a [bus] section with one drive per motor")
    drives = tuple(
        _drive(file, motor, robot.files, place, f"bus.drive[{i}]", traffic)
        for i, (file, motor) in enumerate(zip(robot.bus.drive, robot.motors, strict=True))
    )
    bus = Bus(file=robot.bus, drives=tuple(_with_limits(drive, robot, i) for i, drive in enumerate(drives)))
    refuse_pdos(bus, place)
    for i in range(robot.n):
        refuse_counts(robot, i, robot.bus.drive[i], place)
    return bus


def _with_limits(drive: Drive, robot: Robot, i: int) -> Drive:
    """The limits of the joints that motor `i` moves, at the motor: they add up at worst."""

    def limit(quantity: str) -> float | None:
        moved = [(abs(r), joint.si(quantity)) for r, joint in zip(robot.R[i], robot.joints, strict=True) if r]
        if any(value is None for _, value in moved):
            return None
        return float(sum(r * value for r, value in moved) * drive.position_codec.counts_per_unit)

    per_unit = float(np.abs(robot.R[i]).sum() * drive.position_codec.counts_per_unit)
    slides = robot.joints[int(np.argmax(np.abs(robot.R[i])))].type == "prismatic"
    scale = (per_unit, "m") if slides else (per_unit * np.pi / 180, "deg")
    speed, acceleration = limit("speed"), limit("acceleration")
    return replace(drive, speed_limit=speed, acceleration_limit=acceleration, counts_per_joint=scale)


def _drive(
    file: DriveFile, motor: Motor, files: Mapping[str, bytes], place: str, at: str, traffic: Mapping[int, Values] | None
) -> Drive:
    dictionary, types = None, dict(STANDARD)
    if file.dictionary is not None:
        label = dictionary_label(file.dictionary)
        if label not in files:
            problem = "is missing next to the description"
            raise AcquisitionError(problem, place=place, key=f"{at}.dictionary", value=file.dictionary)
        dictionary = load_dictionary(files[label], file.dictionary, file.node)
        types |= {key: entry.type for key, entry in dictionary.entries.items() if entry.type}
    types |= {parse_object(name): kind for name, kind in file.objects.items()}
    written = {parse_object(name) for name in file.objects}

    def entry(key: str, name: str) -> ObjectEntry:
        index, sub = parse_object(name)
        known = written if dictionary is None else written | set(dictionary.entries)
        if (index, sub) not in types or (dictionary is not None and (index, sub) not in known):
            where = f"{file.dictionary} does not contain it" if dictionary else "its type is not known"
            expected = "an object of the drive, or one in objects"
            raise AcquisitionError(where, place=place, key=f"{at}.{key}", value=name, expected=expected)
        return ObjectEntry(index=index, sub=sub, type=types[index, sub])

    word = "reference" if file.reference is not None else "actual"
    effort = _effort(file, word, entry(word, getattr(file, word) or ""), motor, place, at)
    status, control = entry("status", file.status), entry("control", file.control)
    position, target = entry("position", file.position), entry("target", file.target)
    for key, found in (("position", position), ("target", target)):
        if found.type != POSITION_TYPE:
            name = getattr(file, key)
            raise AcquisitionError(
                f"is {found.type}", place=place, key=f"{at}.{key}", value=name, expected=POSITION_TYPE
            )
    extras = tuple(
        extra_object(e, entry(f"extra[{k}]", e if isinstance(e, str) else e.object), file, motor, place, at)
        for k, e in enumerate(file.extra)
    )
    if file.mapping == "table":
        measured = dict.fromkeys((status, position, effort.entry, *(extra.entry for extra in extras)))
        default = {"tpdo": tuple(measured), "rpdo": (control, target)}
        pdos = {way: _pdos(way, file, default[way], entry, place, at) for way in default}
    else:
        source: Values = {}
        if file.mapping == "dictionary" and dictionary is not None:
            source = {key: e.value for key, e in dictionary.entries.items() if e.value is not None}
        elif traffic is not None:
            source = traffic.get(file.node, {})
        pdos = {way: pdos_of(way, source, types, f"{place}: {at}.mapping") for way in ("tpdo", "rpdo")}
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
            problem = f"{at}.mapping: no PDO from the drive carries {needed}"
            raise AcquisitionError(problem, place=place, expected=f"one ({file.mapping})")
    return drive


def _pdos(
    way: str, file: DriveFile, default: tuple[ObjectEntry, ...], entry: Entry, place: str, at: str
) -> tuple[Pdo, ...]:
    found = []
    wanted: list[tuple[PdoFile | None, tuple[ObjectEntry, ...]]] = [(None, part) for part in _packed(default)]
    if files := getattr(file, way):
        wanted = [
            (pdo, tuple(entry(f"{way}[{k}].objects", name) for name in pdo.objects)) for k, pdo in enumerate(files)
        ]
    for k, (written, entries) in enumerate(wanted):
        key = f"{at}.{way}[{k}]"
        number = (written.number if written else None) or k + 1
        can_id = (written.can_id if written else None) or usual_can_id(way, number, file.node)
        if can_id is None:
            expected = "one: only the first four PDOs have a usual one"
            raise AcquisitionError(place=place, key=f"{key}.can_id", value=None, expected=expected)
        pdo = Pdo(number=number, can_id=can_id, entries=entries)
        if pdo.bits > 64:
            sizes = " + ".join(str(e.bits // 8) for e in entries)
            problem, expected = f"{sizes} = {pdo.length} bytes", "8 at most; use a second PDO"
            raise AcquisitionError(problem, place=place, key=f"{key}.objects", expected=expected)
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


def _effort(file: DriveFile, word: str, entry: ObjectEntry, motor: Motor, place: str, at: str) -> EffortCodec:
    known = EFFORT_OBJECTS.get((entry.index, entry.sub))
    name = getattr(file, f"{word}_rule")
    if name is None:
        if known is None or known.entry.type != entry.type:
            problem, expected = f"{entry} ({entry.type}) is not known", f"one of {', '.join(RULES)}"
            raise AcquisitionError(problem, place=place, key=f"{at}.{word}_rule", value=None, expected=expected)
        name = known.rule
    rule = RULES[name]
    rated = getattr(file, rule.rated) if rule.rated else 1.0
    if rated is None:
        expected = f"the rated value that {name!r} multiplies"
        raise AcquisitionError(place=place, key=f"{at}.{rule.rated}", value=None, expected=expected)
    if rule.unit != motor.recorded_unit:
        key, expected = f"{at}.{word}_rule", f"{motor.recorded_unit} as motor {motor.name!r} says"
        raise AcquisitionError(f"gives {rule.unit}", place=place, key=key, value=name, expected=expected)
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
