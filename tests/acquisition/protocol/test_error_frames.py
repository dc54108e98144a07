"""Error frames in words, against the bits of Linux's `can/error.h` typed out here."""

import pytest

from acquisition.protocol import error_frame_words


@pytest.mark.parametrize(
    ("can_id", "data", "words"),
    [
        (0x002, "0b00000000000000", "arbitration lost: at bit 11"),
        (0x004, "0002000000000000", "controller: transmit overflow"),
        (0x004, "000c000000000000", "controller: warning level of receive errors, warning level "
                                    "of transmit errors"),
        (0x004, "0020000000000000", "controller: error passive by transmit errors"),
        (0x008, "0000048a00000000", "protocol: bit stuffing"),  # 8A is no place in a frame
        (0x008, "0000080800000000", "protocol: dominant bit could not be sent, in checksum"),
        (0x008, "0000700200000000",
         "protocol: recessive bit could not be sent, overload, active error announced, in "
         "identifier bits 28 to 21"),
        (0x010, "0000000075000000", "transceiver: CAN_H short to battery, CAN_L short to ground"),
        (0x040, "0000000000000000", "bus-off"),
        (0x204, "0020000000008000",
         "controller: error passive by transmit errors; 128 transmit errors and 0 receive errors "
         "counted"),
        (0x0A8, "0000001900000000",
         "protocol: in acknowledgement; no acknowledgement: no other node receives, or the cable "
         "is open; bus error"),
        (0x044, "", "controller; bus-off"),
        (0x000, "00000019", "identifier 0x000, data 0000001900000000"),
    ],
)  # fmt: skip
def test_words(can_id, data, words):
    assert error_frame_words(can_id, bytes.fromhex(data)) == words


PLACES = {
    0x02: "identifier bits 28 to 21", 0x03: "start of frame", 0x04: "bit SRTR", 0x05: "bit IDE",
    0x06: "identifier bits 20 to 18", 0x07: "identifier bits 17 to 13", 0x08: "checksum",
    0x09: "reserved bit 0", 0x0A: "data", 0x0B: "length", 0x0C: "bit RTR", 0x0D: "reserved bit 1",
    0x0E: "identifier bits 4 to 0", 0x0F: "identifier bits 12 to 5", 0x12: "intermission",
    0x18: "checksum delimiter", 0x19: "acknowledgement", 0x1A: "end of frame",
    0x1B: "acknowledgement delimiter",
}  # fmt: skip


def test_every_frame_location_has_code():
    found = {code: error_frame_words(0x008, bytes([0, 0, 0, code])) for code in range(256)}
    assert found == {
        code: f"protocol: in {PLACES[code]}" if code in PLACES else "protocol" for code in found
    }


@pytest.mark.parametrize(
    ("can_id", "at", "name", "words"),
    [
        (0x004, 1, "controller",
         ("receive overflow", "transmit overflow", "warning level of receive errors",
          "warning level of transmit errors", "error passive by receive errors",
          "error passive by transmit errors", "error active again")),
        (0x008, 2, "protocol",
         ("single bit", "frame format", "bit stuffing", "dominant bit could not be sent",
          "recessive bit could not be sent", "overload", "active error announced",
          "while sending")),
    ],
)  # fmt: skip
def test_every_detail_bit_has_words(can_id, at, name, words):
    found = [error_frame_words(can_id, bytes(at) + bytes([1 << k])) for k in range(len(words))]
    assert found == [f"{name}: {word}" for word in words]


def test_wire_states():
    states = {4: "no wire", 5: "short to battery", 6: "short to supply", 7: "short to ground"}
    for code, words in states.items():
        assert error_frame_words(0x010, bytes([0, 0, 0, 0, code])) == f"transceiver: CAN_H {words}"
        assert (
            error_frame_words(0x010, bytes([0, 0, 0, 0, code << 4]))
            == f"transceiver: CAN_L {words}"
        )
