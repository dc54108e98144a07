"""A drive's own diagnosis as text: bits of its statusword, error codes, and the objects that hold its last error."""

from ..errors import AcquisitionError
from ..protocol import state_of
from ..robot import Drive, axis_of
from .master import Master

# Bits of the statusword (6041h) other than those of the state; 12 and 13 as in cyclic synchronous position mode (CiA 402-2).
REMOTE, FOLLOWS = 1 << 9, 1 << 12
_SET = {1 << 7: "warning", 1 << 11: "internal limit active", 1 << 13: "following error"}
_CLEAR = {1 << 4: "no voltage on the power stage", REMOTE: "not remote: the controlword is ignored"}
ERROR_REGISTER, ERROR_FIELD, ERROR_CODE = 0x1001, 0x1003, 0x603F
# Error codes of emergencies, 1003h and 603Fh: CiA 301 table 26 and CiA 402-2 annex; a code belongs to its longest prefix.
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
    """The state of a statusword, and those of its other bits that differ from normal operation."""
    try:
        words = [state_of(statusword).words]
    except AcquisitionError:
        words = [f"statusword 0x{statusword:04X}, no state of CiA 402"]
    return ", ".join([*words, *notices(statusword), *(text for bit, text in _CLEAR.items() if not statusword & bit)])


def notices(statusword: int) -> list[str]:
    """Warning, internal limit active, following error, where their bits are set."""
    return [text for bit, text in _SET.items() if statusword & bit]


def error_words(code: int) -> str:
    """An error code with its name: `0x2310 (continuous over current)`."""
    text = f"{code:04X}"
    names = [_CODES[text[:length]] for length in (4, 2, 1) if text[:length] in _CODES]
    return f"0x{text} ({names[0]})" if names else f"0x{text}"


def error_report(master: Master, drive: Drive) -> str:
    """Error register (1001h), last error (1003h:1) and error code (603Fh) in one line; empty where a drive has none of them."""
    values = []
    for index, sub, name in (
        (ERROR_REGISTER, 0, "error register 1001"),
        (ERROR_FIELD, 1, "last error 1003:1"),
        (ERROR_CODE + axis_of(drive), 0, f"error code {ERROR_CODE + axis_of(drive):04X}"),
    ):
        try:
            value = master.read(drive.node, index, sub)
        except AcquisitionError:
            continue  # many drives lack one of them
        values.append(f"{name} = " + (f"0x{value:02X}" if index == ERROR_REGISTER else error_words(value & 0xFFFF)))
    return f"node {drive.node} ({drive.name}): {', '.join(values)}" if values else ""
