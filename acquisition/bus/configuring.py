"""The objects of each drive that a session needs: read, compared, and written where they differ.

A session and `check` use the same list, but `check` only reads. Everything is read before anything
is written, so that a refusal leaves the drives as they are.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from .. import protocol as cia
from ..errors import BadInputError, BusFaultError, RefusedError, SdoAbortedError
from ..robot import Drive, axis_of
from .master import PRE_OPERATIONAL, Master
from .supervision import read_if_there, stop_ramp

Answers = dict[cia.Key, int | SdoAbortedError]
Write = tuple[int, int, int, int]  # index, sub-index, value, size in bytes
# Abort codes of objects that can only be written, and so cannot be compared.
UNREADABLE = (0x06010000, 0x06010001)
# The display must follow the mode of operation within this time.
MODE_S = 0.5
# Relative tolerance of ranges, speeds and ratios; and the speed that means no limit.
TOLERANCE, NO_LIMIT = 0.01, 2**32 - 1
# If range and speed of a drive are the same multiple of the limits at the motor, the ratio is
# probably wrong. This is the smallest multiple, and the largest difference between the two.
MIN_MULTIPLE, MULTIPLES_DIFFER = 2.0, 0.1


@dataclass(frozen=True, kw_only=True)
class Need:
    """A property of a drive that a session needs, as it was read.

    Attributes:
        drive: the drive.
        name: name of the property, with its object.
        found: value in the drive, and what a session writes, as text.
        writes: writes that a session makes, in order; empty if the drive has what is needed.
        refusal: why no session can start; empty if it can.
        track: True if `refusal` forbids only motion.
    """

    drive: Drive
    name: str
    found: str
    writes: tuple[Write, ...] = ()
    refusal: str = ""
    track: bool = False

    def __str__(self) -> str:
        return (
            f"node {self.drive.node} ({self.drive.name}): {self.name}: {self.refusal or self.found}"
        )


def needs_of(master: Master, drive: Drive, *, track: bool) -> Iterator[Need]:
    """Read what a recording needs of a drive, and with `track` also what motion needs.

    Nothing is written.

    Parameters
    ----------
    master : reads the objects.
    drive : the drive.
    track : True to include what motion needs.

    Raises
    ------
    NoAnswerError : the drive does not answer.
    """
    yield from _identity(master, drive)
    beat, every_ms = (cia.HEARTBEAT_TIME, 0), round(master.bus.file.heartbeat_s * 1000)
    yield _values(
        drive, f"heartbeat {beat[0]:04X}", _ask(master, drive, beat), {beat: every_ms}, " ms"
    )
    yield from (_pdo(master, drive, "tpdo", pdo) for pdo in drive.tpdos)
    # Only motion sends PDOs to the drives.
    if track:
        yield from (_pdo(master, drive, "rpdo", pdo) for pdo in drive.rpdos)
        yield _interpolation(master, drive)
        # The display is read too, because a session waits until it follows the mode.
        mode, display = (i + axis_of(drive) for i in (cia.MODE_OF_OPERATION, cia.MODE_DISPLAY))
        yield _values(
            drive,
            f"mode and display {mode:04X} {display:04X}",
            _ask(master, drive, (mode, 0), (display, 0)),
            {(mode, 0): cia.Mode.CYCLIC_SYNCHRONOUS_POSITION},
        )
        yield from _limits(master, drive)


def read_needs(master: Master, *, track: bool) -> list[Need]:
    """Read the needs of all drives before a session.

    Parameters
    ----------
    master : reads the objects.
    track : True if the session moves the robot.

    Raises
    ------
    RefusedError : a drive does not have what the session needs; the text lists everything.
    NoAnswerError : a drive does not answer.
    """
    needs = [need for drive in master.bus.drives for need in needs_of(master, drive, track=track)]
    if unmet := [str(need) for need in needs if need.refusal and (track or not need.track)]:
        raise RefusedError(
            "; ".join(unmet),
            what="the session",
            advice="List all that a recording and motion need: `robot-acquire check ROBOT.toml`",
        )
    return needs


def configure(master: Master, needs: Iterable[Need], *, track: bool) -> list[str]:
    """Set every drive to PRE-OPERATIONAL, and write the objects that differ.

    Parameters
    ----------
    master : has the drives.
    needs : result of `read_needs`.
    track : True if the session moves the robot.

    Returns
    -------
    A warning for each drive whose heartbeat is missing; a recording does without it.

    Raises
    ------
    BusFaultError : a drive refuses a write, or does not change its mode.
    """
    for drive in master.bus.drives:
        master.nmt(PRE_OPERATIONAL, drive.node)
    master.wait(master.link.now_ns() + 20_000_000)
    warnings = []
    for need in needs:
        without = str(need) if need.refusal else ""
        try:
            for write in need.writes:
                _write(master, need.drive.node, write)
        except SdoAbortedError as error:
            if track or not need.track:
                raise
            without = str(error)
        if without:
            master.by_node[need.drive.node].beats = False
            warnings.append(f"{without}: its heartbeat is not monitored")
    for drive in master.bus.drives if track else ():
        _await_mode(master, drive)
    return warnings


def _write(master: Master, node: int, write: Write) -> None:
    index, sub, value, size = write
    # The heartbeat time is U16 in CiA 301, but not in all drives.
    if index == cia.HEARTBEAT_TIME:
        answer = master.upload(node, index, sub)
        size = len(answer.data) if answer.kind == "value" else size
    master.write(node, index, sub, value, size)


def _await_mode(master: Master, drive: Drive) -> None:
    mode, display = cia.Mode.CYCLIC_SYNCHRONOUS_POSITION, cia.MODE_DISPLAY + axis_of(drive)
    until_ns = master.link.now_ns() + round(MODE_S * 1e9)
    while (shown := master.read(drive.node, display)) != mode:
        if master.link.now_ns() > until_ns:
            raise BusFaultError(
                place=f"node {drive.node}",
                key=f"mode of operation ({display:04X}:0)",
                value=shown,
                text="the drive did not change its mode",
                expected=f"{int(mode)} ({mode.name.lower().replace('_', ' ')})",
            )
        master.wait(master.link.now_ns() + 10_000_000)


def _ask(master: Master, drive: Drive, *keys: cia.Key) -> Answers:
    """Read objects of a drive; an object that it refuses has the abort as its value."""

    def answer(key: cia.Key) -> int | SdoAbortedError:
        try:
            return master.read(drive.node, *key)
        except SdoAbortedError as error:
            return error

    return {key: answer(key) for key in keys}


def _name(key: cia.Key) -> str:
    return f"{key[0]:04X}:{key[1]}"


def _need(
    drive: Drive,
    name: str,
    answers: Answers,
    writes: Sequence[Write],
    shown: str,
    *,
    track: bool = True,
) -> Need:
    """Return a property that `writes` set.

    It is refused if an object is missing, if it cannot be read (unless it is written), or if the
    dictionary declares it as read-only.
    """
    keys = dict.fromkeys(write[:2] for write in writes)
    refused = [
        *(
            f"{_name(key)}: {answer.meaning} (0x{answer.code:08X})"
            for key, answer in answers.items()
            if not isinstance(answer, int) and not (key in keys and answer.code in UNREADABLE)
        ),
        *(
            f"{_name(key)} differs, and its dictionary says that it is read-only"
            for key in keys
            if key in drive.entries and not drive.entries[key].writable
        ),
    ]
    return Need(
        drive=drive,
        name=name,
        found=shown + (f"; a session writes {', '.join(map(_name, keys))}" if keys else ""),
        writes=() if refused else tuple(writes),
        refusal=next(iter(refused), ""),
        track=track,
    )


def _values(
    drive: Drive, name: str, answers: Answers, wanted: dict[cia.Key, int], unit: str = ""
) -> Need:
    """Return the need that objects have the raw values `wanted`."""
    differ = {key: value for key, value in wanted.items() if answers[key] != value}
    return _need(
        drive,
        name,
        answers,
        [(*key, value, drive.size_of(*key)) for key, value in differ.items()],
        " ".join(str(x) if isinstance(x, int) else "-" for x in answers.values()) + unit,
    )


def _pdo(master: Master, drive: Drive, way: str, pdo: cia.Pdo) -> Need:
    """Return the needs of a PDO.

    Parts that are right are not written, because the mapping of a drive may be fixed.
    """
    communication, mapping = (first + pdo.number - 1 for first in cia.PARAMETERS[way])
    can_id, kind, count = (communication, 1), (communication, 2), (mapping, 0)
    answers = _ask(master, drive, can_id, kind, count)
    is_mapped = answers[count] == len(pdo.entries) and all(
        # Many drives have no sub-index beyond the count, so the count is compared first.
        _ask(master, drive, (mapping, k))[mapping, k] == entry.mapping
        for k, entry in enumerate(pdo.entries, 1)
    )
    stated, on_sync = answers[can_id], answers[kind] == cia.ON_SYNC
    no_remote = stated & cia.NO_REMOTE if isinstance(stated, int) else 0
    is_right = is_mapped and on_sync and stated == pdo.can_id | no_remote
    return _need(
        drive,
        f"{way.upper()} {pdo.number} {communication:04X} {mapping:04X}",
        answers,
        [
            write
            for write in ([] if is_right else cia.configuration(way, pdo, no_remote))
            if not ((is_mapped and write[0] == mapping) or (on_sync and write[:2] == kind))
        ],
        "as described" if is_right else "differs",
        track=way == "rpdo",
    )


def _interpolation(master: Master, drive: Drive) -> Need:
    """Return the need of the interpolation period, which may be given in any unit.

    If a drive does not have the object, the value in its dictionary counts.
    """
    index, period_s = cia.INTERPOLATION_PERIOD + axis_of(drive), master.bus.file.sync_period_s
    name, answers = f"interpolation period {index:04X}", _ask(master, drive, (index, 1), (index, 2))
    count, unit = (
        drive.entries[key].value
        if not isinstance(answer, int) and answer.code not in UNREADABLE and key in drive.entries
        else answer
        for key, answer in answers.items()
    )
    if isinstance(count, int) and isinstance(unit, int):
        has_s = count * 10.0 ** ((unit + 128) % 256 - 128)
        if abs(has_s - period_s) <= 1e-6 * period_s:
            return Need(drive=drive, name=name, found=f"{has_s * 1e3:g} ms")
    try:
        count, unit = cia.interpolation_period(period_s)
    except BadInputError as error:
        return Need(drive=drive, name=name, found="", refusal=str(error), track=True)
    return _values(drive, name, answers, {(index, 1): count, (index, 2): unit % 256})


def _identity(master: Master, drive: Drive) -> Iterator[Need]:
    """Yield the needs of the identity in the dictionary and of the rated values in robot.toml.

    They are only compared, never written.
    """
    identity = [] if drive.dictionary is None else drive.dictionary.identity
    for name, key, number, form, source in (
        *((name, (cia.IDENTITY, k), x, "0x{:X}", "its dictionary") for k, name, x in identity),
        *(("rated value", (index, 0), x, "{}", "robot.toml") for index, x in drive.rated.items()),
    ):
        if drive.dictionary is None or key in drive.entries:
            answers, wanted = _ask(master, drive, key), form.format(number)
            need = _need(drive, f"{name} {_name(key)}", answers, (), wanted, track=False)
            if not need.refusal and answers[key] != number:
                need = replace(
                    need, refusal=f"{form.format(answers[key])}, but {source} gives {wanted}"
                )
            yield need


def _limits(master: Master, drive: Drive) -> Iterator[Need]:
    """Yield the needs of position limits, motor speed, gear and quick stop deceleration.

    Values that the drive reports are compared with the limits of the joints times the ratio.
    """
    axis, ratio = axis_of(drive), drive.motion.ratio or 0.0
    low, high, home, turns, shaft, rpm, unit = (
        read_if_there(master, drive, index + axis, sub) or 0
        for index, sub in (
            *((cia.POSITION_LIMITS, 1), (cia.POSITION_LIMITS, 2), (cia.HOME_OFFSET, 0)),
            *((cia.GEAR, 1), (cia.GEAR, 2), (cia.MAX_RPM, 0), (cia.VELOCITY_UNIT, 0)),
        )
    )
    low, high = cia.signed(low, 32), cia.signed(high, 32)
    least, most = drive.motion.position or (0.0, 0.0)
    # Ranges are not compared (0) if one of them has no limits, or if a home offset may shift the
    # limits of the drive (CiA 402).
    span = most - least if low < high and not home else 0.0
    fastest = drive.motion.rpm if rpm not in (0, NO_LIMIT) and unit in (0, cia.RPM) else None
    joints, known = "joint limits x ratio", f"the ratio of its motor in robot.toml, {ratio:g}"
    if span:
        yield _compared(
            drive,
            f"position limits {cia.POSITION_LIMITS + axis:04X}",
            f"{low} to {high}",
            f"a range within {least:.0f} to {most:.0f} ({joints})",
            ok=max(low - least, most - high) <= TOLERANCE * span,
        )
    if fastest:
        yield _compared(
            drive,
            f"motor speed {cia.MAX_RPM + axis:04X}",
            f"{rpm} rpm",
            f"at least {fastest:.0f} ({joints})",
            ok=rpm >= (1 - TOLERANCE) * fastest,
        )
    # If the ratio is missing or wrong, range and speed differ by the same factor.
    less, more = sorted([(high - low) / (span or math.inf), rpm / (fastest or math.inf)])
    if ratio and less >= MIN_MULTIPLE:
        yield _compared(
            drive,
            f"ratio {cia.POSITION_LIMITS + axis:04X} {cia.MAX_RPM + axis:04X}",
            f"range and speed are {less:.4g} and {more:.4g} times the {joints}",
            f"1; check {known}",
            ok=more > (1 + MULTIPLES_DIFFER) * less,
        )
    # The ratio in robot.toml may be larger, since it includes stages outside the motor.
    if ratio and shaft:
        yield _compared(
            drive,
            f"gear {cia.GEAR + axis:04X}",
            f"{turns}/{shaft}",
            f"at most {known}",
            ok=ratio * shaft >= (1 - TOLERANCE) * turns,
        )
    ramp, faster = stop_ramp(master, drive)
    yield _compared(drive, "quick stop deceleration", ramp, faster, ok=not faster)


def _compared(drive: Drive, name: str, found: str, expected: str, *, ok: bool) -> Need:
    return Need(
        drive=drive,
        name=name,
        found=found,
        refusal="" if ok else f"{found}: expected {expected}",
        track=True,
    )
