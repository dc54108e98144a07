"""One simulated CiA 402 drive without I/O: objects, SDO server, NMT, states, PDOs, monitoring."""

from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np

from .. import protocol as cia
from ..protocol import Key
from ..robot import Drive, axis_of, parse_homed

# State in heartbeats after an NMT command: operational, stopped, pre-operational.
NMT_STATE = {1: 5, 2: 4, 128: 127}
# A drive without a dictionary monitors at most so many heartbeats.
CONSUMERS = 2

Sent = list[tuple[int, bytes]]


@dataclass(kw_only=True)
class SimulatedNode:
    """A simulated drive.

    Attributes:
        drive: description of the drive.
        types: types of its objects, by index and sub-index.
        values: raw values of its objects.
        read_only: objects that cannot be written.
        initial: values after a boot.
        nmt: NMT state, as in heartbeats.
        state: state of CiA 402.
        waiting: data of RPDOs since the last SYNC, by number of the PDO.
        tpdos: PDOs from the drive.
        rpdos: PDOs to the drive.
        more_status: bits of the statusword other than those of the state.
        boot_up_counts: True if the boot-up was the first heartbeat (CiA 301). The next one is sent
            a heartbeat time later.
    """

    drive: Drive
    types: dict[Key, str]
    values: dict[Key, int]
    read_only: frozenset[Key]
    initial: dict[Key, int] = field(default_factory=dict)
    nmt: int = 127
    state: cia.State = cia.State.SWITCH_ON_DISABLED
    waiting: dict[int, bytes] = field(default_factory=dict)
    tpdos: tuple[cia.Pdo, ...] = ()
    rpdos: tuple[cia.Pdo, ...] = ()
    more_status: int = 0
    boot_up_counts: bool = False

    def boot(self) -> Sent:
        """Reset all values to their initial ones, and return the boot-up message."""
        self.initial = self.initial or dict(self.values)
        self.values = dict(self.initial)
        self.nmt, self.state, self.waiting = 127, cia.State.SWITCH_ON_DISABLED, {}
        self.boot_up_counts = bool(self.values.get((cia.HEARTBEAT_TIME, 0)))
        self._map()
        return [(cia.HEARTBEAT + self.drive.node, b"\0")]

    @property
    def operational(self) -> bool:
        """True if PDOs are sent and received (NMT state operational)."""
        return self.nmt == 5

    def heartbeat(self) -> Sent:
        """Return the heartbeat message."""
        return [(cia.HEARTBEAT + self.drive.node, bytes([self.nmt]))]

    def emergency(self, code: int) -> Sent:
        """Start the fault reaction, and return the emergency message (CiA 301, 7.2.7)."""
        self.state = cia.State.FAULT_REACTION_ACTIVE
        return self.error(code)

    def error(self, code: int) -> Sent:
        """Return an emergency message without a change of state.

        The objects of the last error are set, too.
        """
        last = {(0x1001, 0): 1, (0x1003, 1): code, (0x603F, 0): code}
        self.values |= {key: value for key, value in last.items() if key in self.values}
        return [(cia.EMERGENCY + self.drive.node, code.to_bytes(2, "little") + b"\1\0\0\0\0\0")]

    def receive(self, can_id: int, data: bytes) -> Sent:
        """Return the answers to a frame other than SYNC."""
        node = self.drive.node
        if can_id == 0 and len(data) >= 2 and data[1] in (0, node):
            # These commands reset the node, or its communication.
            if data[0] in (129, 130):
                return self.boot()
            if data[0] in NMT_STATE:
                self.nmt = NMT_STATE[data[0]]
                # With option 0 the drive does not react.
                option = self.values.get((cia.ABORT_CONNECTION, 0), 1)
                if not self.operational and self.state is cia.State.OPERATION_ENABLED and option:
                    # Commands can no longer be received, so the power stage is switched off.
                    self.state = cia.State.SWITCH_ON_DISABLED
        elif can_id == cia.REQUEST + node and self.nmt != 4:
            return [(cia.ANSWER + node, self._serve(data))]
        elif self.operational:
            for pdo in self.rpdos:
                if pdo.can_id == can_id and len(data) >= pdo.length:
                    self.waiting[pdo.number] = data
                    # An event-driven RPDO is applied at once, without SYNC.
                    if self.values.get((cia.PARAMETERS["rpdo"][0] + pdo.number - 1, 2), 1) > 240:
                        self.apply()
        return []

    def apply(self) -> None:
        """Apply the RPDOs received since the last SYNC, the controlword included."""
        for pdo in self.rpdos:
            if (data := self.waiting.pop(pdo.number, None)) is not None:
                for key, value in pdo.unpack(data).items():
                    self._set(key, value)

    def answers(self) -> Sent:
        """Return TPDOs with the current values."""
        return (
            [(pdo.can_id, pdo.pack(self.values)) for pdo in self.tpdos] if self.operational else []
        )

    def tick(self) -> None:
        """Make the automatic transitions of the state machine, and update the statusword."""
        self.state = cia.AUTOMATIC.get(self.state, self.state)
        self.values[self.drive.status.index, 0] = self.statusword

    @property
    def statusword(self) -> int:
        """Bits of the state, voltage enabled, remote, follows its target (if enabled), homed."""
        follows = 0x1000 if self.state is cia.State.OPERATION_ENABLED else 0
        return self.state.value[1] | 0x0210 | follows | self.more_status

    def set_homed(self, name: str) -> None:
        """Set the object or bit that reports the drive as homed."""
        index, sub, bit = parse_homed(name)
        mask = 1 if bit is None else 1 << bit
        if (index, sub) == self.drive.status.key:
            self.more_status |= mask
            self.initial[index, sub] = self.statusword
        else:
            self.types.setdefault((index, sub), "U32")
            self.values[index, sub] = self.initial[index, sub] = (
                self.values.get((index, sub), 0) | mask
            )
        self.tick()

    def _set(self, key: Key, value: int) -> None:
        before = self.values.get(key, 0)
        self.values[key] = value
        if key == (cia.CONTROLWORD, 0):
            command = cia.command_of(value)
            # A fault reset acts only on the rising edge.
            if command is not None and not (command is cia.Command.FAULT_RESET and before & 0x80):
                # Illegal commands are ignored. The statusword must be right for SDO reads, too.
                self.state = cia.TRANSITIONS.get((self.state, command), self.state)
                self.values[self.drive.status.index, 0] = self.statusword
        elif key == (cia.MODE_OF_OPERATION, 0) and (cia.MODE_DISPLAY, 0) in self.values:
            self.values[cia.MODE_DISPLAY, 0] = value

    def _serve(self, data: bytes) -> bytes:
        request = cia.request_of(data)
        key = (request.index, request.sub)
        if request.kind in ("other", "abort"):
            return cia.abort_answer(0, 0, "command specifier not known")
        if key not in self.values or key not in self.types:
            known = any(index == request.index for index, _ in self.values)
            return cia.abort_answer(*key, f"{'sub-index' if known else 'object'} does not exist")
        size = cia.BITS[self.types[key]] // 8
        if request.kind == "read":
            return cia.value_answer(*key, self.values[key], size)
        if key in self.read_only:
            return cia.abort_answer(*key, "write to a read-only object")
        value = int.from_bytes(request.data[:size], "little", signed=self.types[key][0] == "I")
        if refusal := self._refuse_mapping(key, value):
            return cia.abort_answer(*key, refusal)
        self._set(key, value)
        if 0x1400 <= request.index <= 0x1BFF:
            self._map()
        return cia.written_answer(*key)

    def _refuse_mapping(self, key: Key, value: int) -> str:
        """Return why a write to a mapping parameter is not allowed; empty if it is allowed."""
        index, sub = key
        for communication, mapping in cia.PARAMETERS.values():
            if mapping <= index < mapping + cia.MAX_PDOS:
                can_id = self.values.get((index - mapping + communication, 1), cia.NOT_VALID)
                if not can_id & cia.NOT_VALID or (sub and self.values.get((index, 0))):
                    return "not possible in this state"
                if sub and self.types.get((value >> 16, value >> 8 & 0xFF), "U0")[1:] != str(
                    value & 0xFF
                ):
                    return "object cannot be mapped to a PDO"
                words = [self.values.get((index, k)) for k in range(1, 1 if sub else value + 1)]
                if None in words:
                    return "value out of range"
                if sum(word & 0xFF for word in words if word) > cia.MAX_PDO_BITS:
                    return "PDO would be too long"
        return ""

    def _map(self) -> None:
        known = {key: kind for key, kind in self.types.items() if key in self.values}
        self.tpdos, self.rpdos = (
            tuple(
                pdo
                for pdo in cia.pdos_of(way, self.values, known, f"node {self.drive.node}")
                if pdo.bits <= cia.MAX_PDO_BITS and pdo.can_id < 0x800
            )
            for way in cia.PARAMETERS
        )


def _entries_of(index: int, count: int) -> dict[Key, str]:
    """Return the types of an array or a record of U32."""
    return {(index, sub): "U32" if sub else "U8" for sub in range(count + 1)}


def _units_and_limits(drive: Drive) -> dict[Key, int]:
    """Return raw texts, modes, position units and limits of the description.

    Values are 0 if the description does not give them, or if the motor slides.
    """
    per_turn = Fraction(drive.file.counts_per_turn or 0).limit_denominator(1000)
    position, velocity, motor_speed = cia.MOTION_LIMITS
    values = {
        (cia.SUPPORTED_MODES, 0): 1 << cia.Mode.CYCLIC_SYNCHRONOUS_POSITION - 1,
        **{
            # At most four bytes fit into one SDO frame.
            (index, 0): int.from_bytes(text, "little")
            for index, text in zip(cia.TEXTS, (b"sim", b"none", b"none"), strict=True)
        },
    }
    speeds = {velocity: drive.motion.speed or 0.0}
    if per_turn:
        for index, units in zip(cia.POSITION_UNITS, (per_turn, Fraction(1), per_turn), strict=True):
            values |= {(index, 1): units.numerator, (index, 2): units.denominator}
        speeds[motor_speed] = drive.motion.rpm or 0.0
    values |= {(index, 0): int(cia.saturated(np.array(x), "U32")) for index, x in speeds.items()}
    if drive.motion.position is not None:
        low, high = cia.saturated(np.array(drive.motion.position), "I32").tolist()
        values |= {(position, 1): low, (position, 2): high}
    return values


def simulated_node(drive: Drive) -> SimulatedNode:
    """Make a drive with the objects of its dictionary.

    Without a dictionary it has the usual objects, and those in the description.
    """
    read_only: frozenset[Key] = frozenset()
    if drive.dictionary is not None:
        entries = {key: entry for key, entry in drive.dictionary.entries.items() if entry.type}
        types = {key: entry.type for key, entry in entries.items()}
        values = {key: entry.value or 0 for key, entry in entries.items()}
        read_only = frozenset(key for key, entry in entries.items() if not entry.writable)
        values |= {(cia.IDENTITY, sub): number for sub, _, number in drive.dictionary.identity}
        # PDOs are disabled at the start, because the master enables those that it uses.
        values |= {
            (index, sub): value | cia.NOT_VALID
            for (index, sub), value in values.items()
            for first, _ in cia.PARAMETERS.values()
            if sub == 1 and first <= index < first + cia.MAX_PDOS
        }
    else:
        types = (
            dict(cia.STANDARD)
            | {
                entry.key: entry.type
                for entry in (
                    *(drive.status, drive.control, drive.position, drive.target),
                    *(drive.effort.entry, *drive.extras),
                )
            }
            | {(0x1001, 0): "U8", (0x1003, 0): "U8", (0x1003, 1): "U32", (0x603F, 0): "U16"}
            | _entries_of(cia.IDENTITY, 4)
            | _entries_of(cia.CONSUMER_HEARTBEAT, CONSUMERS)
        )
        for communication, mapping in cia.PARAMETERS.values():
            for k in range(4):
                types |= {
                    **_entries_of(communication + k, 1),
                    (communication + k, 2): "U8",
                    **_entries_of(mapping + k, 8),
                }
        stated = _units_and_limits(drive)
        types |= dict.fromkeys(stated.keys() - types, "U32")
        # By CiA 402 these values select a fault for a lost master, no following error window, and
        # the quick stop deceleration.
        values = (
            dict.fromkeys(types, 0)
            | stated
            | {
                (cia.DEVICE_TYPE, 0): 0x00020192,
                (cia.CONSUMER_HEARTBEAT, 0): CONSUMERS,
                (cia.IDENTITY, 0): 4,
                (cia.ABORT_CONNECTION, 0): 1,
                (cia.FOLLOWING_ERROR_WINDOW, 0): 2**32 - 1,
            }
            | dict.fromkeys(((option, 0) for option in cia.STOP_OPTIONS), 2)
            | {
                (first + k, 1): cia.NOT_VALID
                for first, _ in cia.PARAMETERS.values()
                for k in range(4)
            }
        )
    values |= {(index, 0): raw for index, raw in drive.rated.items() if (index, 0) in values}
    node = SimulatedNode(drive=drive, types=types, values=values, read_only=read_only)
    node.tick()
    node.boot()
    return node


# An enabled drive goes into fault after so long without SYNC, as real drives are set to do.
SYNC_LOST_NS = 100_000_000
FOLLOWING_ERROR_CODE, NO_WINDOW = 0x8611, 2**32 - 1
HEARTBEAT_LOST_CODE = 0x8130  # CiA 301: life guard or heartbeat error
# New state of an enabled drive that loses the master, by the option code 6007h. Option 1, fault, is
# handled separately.
_REACTIONS = {2: cia.State.SWITCH_ON_DISABLED, 3: cia.State.QUICK_STOP_ACTIVE}


class Supervision:
    """The monitoring functions of one drive, if `supervised`.

    It monitors heartbeats, SYNC, and the following error (over `window` counts).

    Attributes:
        sync_ns: time of the last SYNC, ns; None before the first.
    """

    def __init__(self, node: SimulatedNode, window: float, *, supervised: bool) -> None:
        self._node, self._watches_sync = node, supervised
        if not supervised:
            node.values = {
                key: value for key, value in node.values.items() if key[0] != cia.CONSUMER_HEARTBEAT
            }
            node.values[cia.ABORT_CONNECTION, 0] = 0
            node.initial = dict(node.values)
            window = NO_WINDOW
        self._window = (cia.FOLLOWING_ERROR_WINDOW + axis_of(node.drive), 0)
        if self._window in node.values:
            node.values[self._window] = node.initial[self._window] = round(min(window, NO_WINDOW))
        # By sub-index of 1016h: its entry at the last heartbeat, and the time of that heartbeat.
        self._heard: dict[int, tuple[int, int]] = {}
        self.sync_ns: int | None = None

    def follow(self, counts: float) -> Sent:
        """React to a following error in counts. Return the emergency message if it is too large."""
        window = self._node.values.get(self._window, NO_WINDOW)
        beyond = (
            self._node.state is cia.State.OPERATION_ENABLED
            and window != NO_WINDOW
            and abs(counts) > window
        )
        return self._fault(FOLLOWING_ERROR_CODE) if beyond else []

    def heartbeat(self, now_ns: int, producer: int) -> None:
        """Note the time of a heartbeat.

        It starts the consumers of its producer (CiA 301, 7.2.8.3.3).
        """
        values = self._node.values
        for sub in range(1, values.get((cia.CONSUMER_HEARTBEAT, 0), 0) + 1):
            entry = values.get((cia.CONSUMER_HEARTBEAT, sub), 0)
            if entry >> 16 == producer and entry & 0xFFFF:
                self._heard[sub] = (entry, now_ns)

    def due_ns(self) -> int | None:
        """Return when a heartbeat or SYNC counts as lost next; None if nothing is monitored."""
        due = (*self._deadlines().values(), self._sync_lost_ns)
        return min((time_ns for time_ns in due if time_ns is not None), default=None)

    def advance(self, now_ns: int) -> Sent:
        """React to lost heartbeats and lost SYNC, and return the emergency messages."""
        lost = [sub for sub, deadline in self._deadlines().items() if now_ns >= deadline]
        # Monitoring starts again at the next heartbeat.
        self._heard = {sub: heard for sub, heard in self._heard.items() if sub not in lost}
        sent = self._react_to_lost_heartbeat() if lost else []
        if self._sync_lost_ns is not None and now_ns >= self._sync_lost_ns:
            sent += self._fault(0x8700)  # CiA 301: sync controller
        return sent

    @property
    def _sync_lost_ns(self) -> int | None:
        supervised = self._watches_sync and self._node.state not in cia.DISABLED
        return None if self.sync_ns is None or not supervised else self.sync_ns + SYNC_LOST_NS

    def _deadlines(self) -> dict[int, int]:
        """Return the time at which each consumer times out, by sub-index.

        A rewritten entry starts with the next heartbeat.
        """
        values = self._node.values
        self._heard = {
            sub: heard
            for sub, heard in self._heard.items()
            if values.get((cia.CONSUMER_HEARTBEAT, sub)) == heard[0]
        }
        return {
            sub: then_ns + (entry & 0xFFFF) * 1_000_000
            for sub, (entry, then_ns) in self._heard.items()
        }

    def _react_to_lost_heartbeat(self) -> Sent:
        node, option = self._node, self._node.values.get((cia.ABORT_CONNECTION, 0), 0)
        if option == 1:
            return self._fault(HEARTBEAT_LOST_CODE)
        if node.state is cia.State.OPERATION_ENABLED:
            node.state = _REACTIONS.get(option, node.state)
        node.tick()
        return node.error(HEARTBEAT_LOST_CODE)

    def _fault(self, code: int) -> Sent:
        frames = self._node.emergency(code)
        self._node.tick()
        return frames
