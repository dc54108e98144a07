"""An error frame of SocketCAN as text (Linux, `include/uapi/linux/can/error.h`)."""

# Bit of the identifier: class of the error.
_CLASSES = {
    0x001: "a frame could not be sent in time",
    0x002: "arbitration lost",
    0x004: "controller",
    0x008: "protocol",
    0x010: "transceiver",
    0x020: "no acknowledgement: no other node hears, or the cable is open",
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
_SHORT_TO_EACH_OTHER = 0x80  # of byte 4
_COUNTERS = 0x200  # class: bytes 6 and 7 hold the controller's error counters


def error_frame_words(can_id: int, data: bytes) -> str:
    """The classes of an error frame and their details; its bytes in hex where no class is known (another adapter's frame)."""
    data = data.ljust(8, b"\0")
    details = {
        0x002: [f"at bit {data[0]}"] if data[0] else [],
        0x004: [words for bit, words in _CONTROLLER.items() if data[1] & bit],
        0x008: [words for bit, words in _PROTOCOL.items() if data[2] & bit]
        + ([f"in {_LOCATIONS[data[3]]}"] if data[3] in _LOCATIONS else []),
        0x010: _wires(data[4]),
    }
    parts = []
    for bit, words in _CLASSES.items():
        if can_id & bit:
            parts.append(f"{words}: {', '.join(details[bit])}" if details.get(bit) else words)
    if can_id & _COUNTERS:
        parts.append(f"{data[6]} transmit errors and {data[7]} receive errors counted")
    return "; ".join(parts) or f"identifier 0x{can_id:03X}, data {data.hex()}"


def _wires(state: int) -> list[str]:
    wires = [f"CAN_{name} {_WIRE[half]}" for name, half in (("H", state & 0xF), ("L", state >> 4)) if half in _WIRE]
    return wires + (["CAN_L short to CAN_H"] if state & 0xF0 == _SHORT_TO_EACH_OTHER else [])
