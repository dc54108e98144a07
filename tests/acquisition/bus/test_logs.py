"""Lines of candump, by its manual."""

from acquisition.bus import read_log
from acquisition.recording import ERROR, EXTENDED, REMOTE_REQUEST, SENT

LINES = [  # line of candump, and what it says: time in ns, identifier, flags, bytes
    ("(1.5) can0 080#", (1_500_000_000, 0x80, 0, "")),
    ("(1700000000.123456789) can0 181#00ffA1", (1700000000123456789, 0x181, 0, "00ffa1")),
    ("(2147483647.999999) can0 1AB#0011223344556677_B", (2147483647999999000, 0x1AB, 0,
                                                         "0011223344556677")),
    ("  (1.000001)\tcan0  7ff#05 T\r", (1_000_001_000, 0x7FF, SENT, "05")),
    ("(1.0) can0 00000080#01 R", (10**9, 0x80, EXTENDED, "01")),
    ("(1.0) can0 1FFFFFFF#", (10**9, 0x1FFFFFFF, EXTENDED, "")),
    ("(1.0) can0 181#R", (10**9, 0x181, REMOTE_REQUEST, "")),
    ("(1.0) can0 181#R8", (10**9, 0x181, REMOTE_REQUEST, "")),
    ("(1.0) can0 20000088#0000000000000000", (10**9, 0x88, ERROR, "00" * 8)),
]  # fmt: skip


def test_candump_lines(tmp_path):
    path = tmp_path / "a.log"
    path.write_bytes("".join(f"{line}\n\n" for line, _ in LINES).encode())
    frames, left_out = read_log(path)
    assert [
        (f["time_ns"], f["can_id"], f["flags"], f["data"][: f["length"]].tobytes().hex())
        for f in frames["can0"]
    ] == [said for _, said in LINES]
    assert not left_out
