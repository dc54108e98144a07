"""The heartbeat of this master, and the monitoring functions of the drives, as text.

The heartbeat is sent only at SYNC. A session that hangs therefore sends none, and the drives that
monitor it (CiA 301, 1016h) stop.
"""

import math

from .. import protocol as cia
from ..errors import BusFaultError, NoAnswerError, RefusedError, SdoAbortedError, holding
from ..robot import BusFile, Drive, axis_of
from .links import SHARED
from .master import OPERATIONAL, Master


def timeout_ms(file: BusFile) -> int:
    """Return the time without a heartbeat after which a drive reacts, ms.

    It is three heartbeat intervals or three SYNC periods, whichever is longer.
    """
    return math.ceil(round(3 * max(file.heartbeat_s, file.sync_period_s) * 1000, 6))


def entry_of(file: BusFile) -> int:
    """Return the value that this master writes to 1016h: node id << 16 | timeout in ms."""
    return file.master_node << 16 | timeout_ms(file)


def heartbeat_consumers(master: Master, node: int) -> list[int]:
    """Read the entries of 1016h of a drive, from sub-index 1.

    Raises
    ------
    BusFaultError : the drive does not have 1016h, or does not answer.
    """
    return [
        master.read(node, cia.CONSUMER_HEARTBEAT, k + 1)
        for k in range(master.read(node, cia.CONSUMER_HEARTBEAT, 0))
    ]


def free_entry(entries: list[int], master_node: int) -> int | None:
    """Return the sub-index of 1016h for `master_node`: its own, or an unused one.

    An entry is unused if its time is 0, or if its node id is not valid. The result is None if no
    entry is free.
    """
    own = [k for k, entry in enumerate(entries, 1) if entry >> 16 == master_node]
    unused = [
        k for k, entry in enumerate(entries, 1) if not entry & 0xFFFF or not 1 <= entry >> 16 <= 127
    ]
    return next(iter(own + unused), None)


class MasterHeartbeat:
    """The heartbeat of this master.

    Call `request` before the first SYNC, and `release` once the drives are disabled.
    """

    def __init__(self, master: Master) -> None:
        self._master, self._file = master, master.bus.file
        # Sub-index of 1016h and its value before, by node id.
        self._before: dict[int, tuple[int, int]] = {}
        # Heartbeats are sent at SYNC: at the last one within `heartbeat_s` of the one before.
        self._due_ns = round(self._file.heartbeat_s * 1e9) - master.bus.period_ns
        self._sent_ns: int | None = None

    def request(self) -> list[str]:
        """Write this master to 1016h of every drive, and start the heartbeat.

        A warning is returned for each drive that does not monitor it.
        """
        refused = []
        for drive in self._master.bus.drives:
            node, entry = drive.node, entry_of(self._file)
            try:
                entries = heartbeat_consumers(self._master, node)
                sub = free_entry(entries, self._file.master_node)
                if sub is None:
                    raise BusFaultError("no sub-index is free", place=f"node {node}: object 1016")
                before = entries[sub - 1]
                # A session that was killed has left an entry of this master, which is removed at
                # the end.
                self._before[node] = (sub, 0 if before == entry else before)
                self._master.write(node, cia.CONSUMER_HEARTBEAT, sub, entry, 4)
            except BusFaultError as error:
                self._before.pop(node, None)
                refused.append(f"{error}; the drive does not detect the loss of this master")
        self._master.at_sync = self._at_sync
        return refused

    def release(self, disabled: list[int]) -> list[str]:
        """Restore 1016h of the `disabled` nodes, then end the heartbeat, at which all others stop.

        A warning is returned for each drive that refuses the write.
        """
        refused = []
        for node in disabled:
            if node in self._before:
                sub, before = self._before.pop(node)
                try:
                    self._send()
                    self._master.write(node, cia.CONSUMER_HEARTBEAT, sub, before, 4)
                except BusFaultError as error:
                    refused.append(str(error))
        self._master.at_sync = lambda: None
        return refused

    def _at_sync(self) -> None:
        if self._sent_ns is None or self._master.link.now_ns() - self._sent_ns > self._due_ns:
            self._send()

    def _send(self) -> None:
        self._sent_ns = self._master.link.now_ns()
        self._master.link.send(cia.HEARTBEAT + self._file.master_node, bytes([OPERATIONAL]))


ERROR_BEHAVIOUR, RPDO_PARAMETERS = 0x1029, 0x1400  # of CiA 301
NO_WINDOW = 2**32 - 1
# A quick stop deceleration below this share of the acceleration limit is refused.
MIN_RAMP_SHARE = 0.5

_RAMPS = {
    1: "slow-down deceleration",
    2: "quick stop deceleration",
    3: "current limit",
    4: "voltage limit",
}
_THEN_OFF = {0: "voltage off at once, the motor coasts"} | {
    k: f"{ramp}, then off" for k, ramp in _RAMPS.items()
}
# Meaning of the option codes (CiA 402-2, IEC 61800-7-201) and of 1029h (CiA 301).
OPTIONS = {
    cia.ABORT_CONNECTION: {
        0: "a lost heartbeat has no effect",
        1: "fault when the connection is lost",
        2: "voltage off when the connection is lost",
        3: "quick stop when the connection is lost",
    },
    cia.QUICK_STOP_OPTION: _THEN_OFF
    | {k + 4: f"{ramp}, then held in quick stop active" for k, ramp in _RAMPS.items()},
    cia.SHUTDOWN_OPTION: {k: _THEN_OFF[k] for k in (0, 1)},
    cia.DISABLE_OPTION: {k: _THEN_OFF[k] for k in (0, 1)},
    cia.FAULT_OPTION: _THEN_OFF,
    ERROR_BEHAVIOUR: {0: "pre-operational", 1: "no change of the NMT state", 2: "stopped"},
}
_STOPS = dict(
    zip(
        cia.STOP_OPTIONS,
        ("quick stop", "shutdown", "disable operation", "fault reaction"),
        strict=True,
    )
)
NOT_THERE = "does not exist"
Property = tuple[str, str]  # of a drive: name, value in words


def supervision_of(master: Master, drive: Drive) -> list[Property]:
    """Describe the monitoring functions of a drive: loss of the master, stops, following error.

    These objects are read: 1016h, 6007h, 1029h, 1400h:5, 605Ah, 605Bh, 605Ch, 605Eh, 6065h, 6066h.
    An object that the drive does not have is described as missing, and no error is raised.

    Returns
    -------
    Names and values, as text.
    """
    behaviour, timer = (
        read_if_there(master, drive, ERROR_BEHAVIOUR, 1),
        read_if_there(master, drive, RPDO_PARAMETERS, 5),
    )
    return [
        _consumers(master, drive),
        _option(master, drive, cia.ABORT_CONNECTION, "reaction"),
        (
            f"communication error {ERROR_BEHAVIOUR:04X}:1",
            f"{NOT_THERE}: pre-operational (CiA 301)"
            if behaviour is None
            else _in_words(ERROR_BEHAVIOUR, behaviour),
        ),
        (
            f"missing targets {RPDO_PARAMETERS:04X}:5",
            f"{timer}: an error after {timer} ms without the PDO"
            if timer
            else f"{NOT_THERE if timer is None else 0}: a missing PDO to the drive has no effect",
        ),
        *(_option(master, drive, index, name) for index, name in _STOPS.items()),
        _following_error(master, drive),
    ]


def stop_ramp(master: Master, drive: Drive) -> tuple[str, str]:
    """Read the quick stop deceleration of a drive.

    Returns
    -------
    The deceleration as text, and the one that motion requires if the former is too low; else empty.
    """
    watch = master.by_node[drive.node]
    for index in cia.RAMP_OBJECTS:
        watch.ramp_objects[index] = read_if_there(master, drive, index + axis_of(drive))
    ramp = cia.quick_stop_ramp(watch.ramp_objects, drive.position_codec)
    scale, unit = drive.motion.counts_per_joint
    if ramp is None:
        return (
            "unknown: voltage is switched off if the speed does not fall by 5 % in 0.05 s",
            "",
        )
    speed, min_ramp = drive.motion.speed, MIN_RAMP_SHARE * (drive.motion.acceleration or 0.0)
    rest = f", {speed / ramp:.3g} s from the speed limit to rest" if speed else ""
    return (
        f"{ramp / scale:.4g} {unit}/s²{rest}",
        ""
        # Drives report whole counts.
        if ramp >= min_ramp - 1
        else f"at least {min_ramp / scale:.4g} for motion, half the acceleration limit",
    )


def supervision_refusal(master: Master, drive: Drive) -> str:
    """Return the monitoring functions that a drive lacks, as text; empty if it lacks none.

    If this computer loses power, nothing else stops the drive.
    """
    reaction, window = (
        index + axis_of(drive) for index in (cia.ABORT_CONNECTION, cia.FOLLOWING_ERROR_WINDOW)
    )
    try:
        sub = free_entry(heartbeat_consumers(master, drive.node), master.bus.file.master_node)
    except (NoAnswerError, SdoAbortedError):
        sub = None
    lacks = {
        f"a lost master has no effect (1016 has no free entry, {reaction:04X} is 0 or missing)": (
            sub is None and not read_if_there(master, drive, reaction)
        ),
        f"the following error is not monitored ({window:04X} is off or missing)": (
            read_if_there(master, drive, window) in (None, NO_WINDOW)
        ),
    }
    return " and ".join(holding(lacks))


def refuse_unsupervised(master: Master) -> None:
    """Raise `RefusedError` if a drive does not monitor its master or its following error."""
    for drive in master.bus.drives:
        if refusal := supervision_refusal(master, drive):
            raise RefusedError(
                refusal,
                what="motion",
                place=f"node {drive.node} ({drive.name})",
                key="supervision",
                advice="Enable this in the drive, or allow motion without it",
                arguments=("unsupervised_drives",),
            )


def second_stop(file: BusFile) -> str:
    """Describe whether the watchdog can stop the drives if the session dies or hangs."""
    return (
        "the recorder's process stops the drives if a session dies or hangs in motion"
        if file.interface in SHARED
        else f"none, because {file.interface} can be opened only once: if the session dies or "
        "hangs, only the monitoring functions of the drives stop them"
    )


def _consumers(master: Master, drive: Drive) -> Property:
    file, name = master.bus.file, f"consumer heartbeat {cia.CONSUMER_HEARTBEAT:04X}"
    try:
        entries = heartbeat_consumers(master, drive.node)
    except (NoAnswerError, SdoAbortedError):
        return name, f"{NOT_THERE}, so the drive does not detect the loss of the master"
    used = ", ".join(
        f"node {e >> 16 & 0x7F} {e & 0xFFFF} ms" for e in entries if e >> 16 and e & 0xFFFF
    )
    sub = free_entry(entries, file.master_node)
    return name, (used or "none in use") + (
        "; no sub-index is free, so the drive does not detect the loss of the master"
        if sub is None
        else f"; motion writes 0x{entry_of(file):08X} (node {file.master_node}, "
        f"{timeout_ms(file)} ms) to sub-index {sub}"
    )


def _option(master: Master, drive: Drive, index: int, name: str) -> Property:
    """Return an option code and its meaning.

    The CiA 402 objects of each further axis are 800h higher.
    """
    raw, name = (
        read_if_there(master, drive, index + axis_of(drive)),
        f"{name} {index + axis_of(drive):04X}",
    )
    return name, NOT_THERE if raw is None else _in_words(index, cia.signed(raw, 16))


def _in_words(index: int, value: int) -> str:
    return f"{value}: {OPTIONS[index].get(value, 'manufacturer-specific')}"


def _following_error(master: Master, drive: Drive) -> Property:
    axis = axis_of(drive)
    window, time_ms = (
        read_if_there(master, drive, index + axis)
        for index in (cia.FOLLOWING_ERROR_WINDOW, cia.FOLLOWING_ERROR_TIME)
    )
    name = f"following error {cia.FOLLOWING_ERROR_WINDOW + axis:04X}"
    if window is None or window == NO_WINDOW:
        return name, NOT_THERE if window is None else f"0x{window:X}: off"
    return name, f"{window}: an error of more than {window} position units of the drive" + (
        "" if time_ms is None else f", after {time_ms} ms ({cia.FOLLOWING_ERROR_TIME + axis:04X})"
    )


def read_if_there(master: Master, drive: Drive, index: int, sub: int = 0) -> int | None:
    """Read an object as an unsigned number.

    The result is None if the drive does not have the object, or does not answer.
    """
    if drive.dictionary is not None and (index, sub) not in drive.dictionary.entries:
        return None
    try:
        return master.read(drive.node, index, sub)
    except (NoAnswerError, SdoAbortedError):
        return None
