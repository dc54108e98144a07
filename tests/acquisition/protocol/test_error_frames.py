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


def test_states_of_the_wires():
    states = {4: "no wire", 5: "short to battery", 6: "short to supply", 7: "short to ground"}
    for code, words in states.items():
        assert error_frame_words(0x010, bytes([0, 0, 0, 0, code])) == f"transceiver: CAN_H {words}"
        assert (
            error_frame_words(0x010, bytes([0, 0, 0, 0, code << 4]))
            == f"transceiver: CAN_L {words}"
        )
