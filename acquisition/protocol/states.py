"""States, commands and transitions of CiA 402; statuswords, error codes and error frames in words.

Names, bits and transitions are those of CiA 402-2 (IEC 61800-7-201): statusword 6041h, controlword
6040h.
"""

from enum import Enum, IntEnum

from ..errors import BusFaultError


class State(Enum):
    """A state of the drive, with its bits in the statusword: (mask, value)."""

    NOT_READY_TO_SWITCH_ON = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def words(self) -> str:
        """Name in lower case, with blanks."""
        return self.name.lower().replace("_", " ")


class Command(Enum):
    """A command of the controlword, with its bits: (mask, value).

    In operation enabled, SWITCH_ON is the command "disable operation".
    """

    SHUTDOWN = (0x87, 0x06)
    SWITCH_ON = (0x8F, 0x07)
    ENABLE_OPERATION = (0x8F, 0x0F)
    DISABLE_VOLTAGE = (0x82, 0x00)
    QUICK_STOP = (0x86, 0x02)
    FAULT_RESET = (0x80, 0x80)  # acts on the rising edge

    @property
    def controlword(self) -> int:
        """Value for 6040h."""
        return self.value[1]


class Mode(IntEnum):
    """A mode of operation, 6060h and 6061h."""

    CYCLIC_SYNCHRONOUS_POSITION = 8


_S, _C = State, Command

# State after a command (transitions 2 to 12, 15, 16). Any other command is illegal in that state.
TRANSITIONS: dict[tuple[State, Command], State] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
    (_S.FAULT, _C.FAULT_RESET): _S.SWITCH_ON_DISABLED,  # 15
    (_S.QUICK_STOP_ACTIVE, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 16
}

# Transitions without a command (1 and 14). Transition 13, from any state to FAULT_REACTION_ACTIVE,
# is made by the drive itself.
AUTOMATIC: dict[State, State] = {
    _S.NOT_READY_TO_SWITCH_ON: _S.SWITCH_ON_DISABLED,
    _S.FAULT_REACTION_ACTIVE: _S.FAULT,
}

# A drive gives no torque in these states, because its power stage is off or it follows no target.
DISABLED = frozenset(State) - {_S.OPERATION_ENABLED, _S.QUICK_STOP_ACTIVE, _S.FAULT_REACTION_ACTIVE}


def find_state(statusword: int) -> State | None:
    """Return the state in a statusword (6041h); None if the bits are not those of a state."""
    return next((s for s in State if statusword & s.value[0] == s.value[1]), None)


def state_of(statusword: int) -> State:
    """Return the state in a statusword (6041h).

    Raises
    ------
    BusFaultError : the bits are not those of a state.
    """
    if (state := find_state(statusword)) is None:
        raise BusFaultError(f"statusword 0x{statusword:04X} is not a CiA 402 state")
    return state


def command_of(controlword: int) -> Command | None:
    """Return the command in a controlword (6040h); None if the bits are not those of a command."""
    # A fault reset takes precedence over all other commands.
    return next((c for c in reversed(Command) if controlword & c.value[0] == c.value[1]), None)


def toward(state: State, goal: State) -> Command | None:
    """Return the first command on the shortest way from `state` to `goal`; None if none is needed.

    Raises
    ------
    BusFaultError : no commands lead there.
    """
    reached: dict[State, Command | None] = {state: None}
    queue = [state]
    for at in queue:
        if at is goal:
            return reached[at]
        automatic = (((was, None), then) for was, then in AUTOMATIC.items())
        for (was, command), then in (*TRANSITIONS.items(), *automatic):
            if was is at and then not in reached:
                reached[then] = command if at is state else reached[at]
                queue.append(then)
    raise BusFaultError(f"no command leads from {state.words} to {goal.words}")


# Bit of the identifier: class of the error.
_CLASSES = {
    0x001: "a frame could not be sent in time",
    0x002: "arbitration lost",
    0x004: "controller",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no acknowledgement: no other node receives, or the cable is open",
    0x040: "bus-off",
    0x080: "bus error",
    0x100: "controller restarted",
}
# Bits of byte 1, with the class of the controller.
_CONTROLLER = {
    0x01: "receive overflow",
    0x02: "transmit overflow",
    0x04: "warning level of receive errors",
    0x08: "warning level of transmit errors",
    0x10: "error passive by receive errors",
    0x20: "error passive by transmit errors",
    0x40: "error active again",
}
# Bits of byte 2, with the class of the protocol.
_PROTOCOL = {
    0x01: "single bit",
    0x02: "frame format",
    0x04: "bit stuffing",
    0x08: "dominant bit could not be sent",
    0x10: "recessive bit could not be sent",
    0x20: "overload",
    0x40: "active error announced",
    0x80: "while sending",
}
# Values of byte 3, with the class of the protocol: where in the frame.
_LOCATIONS = {
    0x02: "identifier bits 28 to 21",
    0x03: "start of frame",
    0x04: "bit SRTR",
    0x05: "bit IDE",
    0x06: "identifier bits 20 to 18",
    0x07: "identifier bits 17 to 13",
    0x08: "checksum",
    0x09: "reserved bit 0",
    0x0A: "data",
    0x0B: "length",
    0x0C: "bit RTR",
    0x0D: "reserved bit 1",
    0x0E: "identifier bits 4 to 0",
    0x0F: "identifier bits 12 to 5",
    0x12: "intermission",
    0x18: "checksum delimiter",
    0x19: "acknowledgement",
    0x1A: "end of frame",
    0x1B: "acknowledgement delimiter",
}
# Values of either half of byte 4, with the class of the transceiver.
_WIRE = {0x4: "no wire", 0x5: "short to battery", 0x6: "short to supply", 0x7: "short to ground"}


def error_frame_words(can_id: int, data: bytes) -> str:
    """Describe the classes of an error frame and their details.

    If no class is known (another adapter), the text is identifier and data in hexadecimal.
    """
    data = data.ljust(8, b"\0")
    halves = ("H", data[4] & 0xF), ("L", data[4] >> 4)
    details = {
        0x002: [f"at bit {data[0]}"] if data[0] else [],
        0x004: [words for bit, words in _CONTROLLER.items() if data[1] & bit],
        0x008: [words for bit, words in _PROTOCOL.items() if data[2] & bit]
        + ([f"in {_LOCATIONS[data[3]]}"] if data[3] in _LOCATIONS else []),
        0x010: [f"CAN_{name} {_WIRE[half]}" for name, half in halves if half in _WIRE]
        + (["CAN_L short to CAN_H"] if data[4] & 0xF0 == 0x80 else []),
    }
    # The last class shows that bytes 6 and 7 hold the controller's error counters.
    counted = {0x200: f"{data[6]} transmit errors and {data[7]} receive errors counted"}
    parts = [
        f"{words}: {', '.join(details[bit])}" if details.get(bit) else words
        for bit, words in (_CLASSES | counted).items()
        if can_id & bit
    ]
    return "; ".join(parts) or f"identifier 0x{can_id:03X}, data {data.hex()}"


# Bits of the statusword (6041h) other than those of the state. 12 and 13 are those of the mode
# cyclic synchronous position (CiA 402-2).
REMOTE, FOLLOWS = 1 << 9, 1 << 12
_SET = {1 << 7: "warning", 1 << 11: "internal limit active", 1 << 13: "following error"}
_CLEAR = {1 << 4: "no voltage on the power stage", REMOTE: "not remote: the controlword is ignored"}
# Error codes of emergencies, 1003h and 603Fh (CiA 301 table 26 and CiA 402-2 annex). The meaning of
# a code is that of its longest prefix.
_CODES = {
    "1": "generic",
    "2": "current",
    "21": "current at the input",
    "22": "current inside the device",
    "23": "current at the output",
    "2310": "continuous over current",
    "2320": "short circuit or earth leakage",
    "3": "voltage",
    "31": "mains voltage",
    "32": "DC link voltage",
    "3210": "DC link over-voltage",
    "3220": "DC link under-voltage",
    "33": "output voltage",
    "4": "temperature",
    "41": "ambient temperature",
    "42": "device temperature",
    "43": "drive temperature",
    "5": "device hardware",
    "6": "device software",
    "63": "data set",
    "7": "additional modules",
    "71": "power electronics",
    "72": "measurement circuit",
    "73": "sensor",
    "7305": "incremental encoder 1",
    "75": "communication inside the device",
    "8": "monitoring",
    "81": "communication",
    "8110": "CAN overrun",
    "8120": "CAN error passive",
    "8130": "lost heartbeat or life guard",
    "8140": "recovered from bus off",
    "82": "protocol",
    "8210": "PDO too short",
    "83": "torque control",
    "84": "speed control",
    "85": "position control",
    "86": "positioning",
    "8611": "following error",
    "8612": "position limit",
    "87": "SYNC",
    "9": "external",
    "F": "additional functions",
    "FF": "device specific",
}


def status_words(statusword: int) -> str:
    """Describe the state in a statusword, and its other bits that differ from normal operation."""
    state = find_state(statusword)
    return ", ".join(
        [
            state.words
            if state
            else f"statusword 0x{statusword:04X}, which is not a CiA 402 state",
            *notices(statusword),
            *(text for bit, text in _CLEAR.items() if not statusword & bit),
        ]
    )


def notices(statusword: int) -> list[str]:
    """Return the texts of these bits, if set: warning, internal limit active, following error."""
    return [text for bit, text in _SET.items() if statusword & bit]


def error_words(code: int) -> str:
    """Return an error code with its name: `0x2310 (continuous over current)`."""
    text = f"{code:04X}"
    names = (f" ({_CODES[text[:n]]})" for n in (4, 2, 1) if text[:n] in _CODES)
    return f"0x{text}{next(names, '')}"
