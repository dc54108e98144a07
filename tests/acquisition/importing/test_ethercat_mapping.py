"""Mappings in captures of EtherCAT: what the slaves confirmed, refused, or did not answer (CoE)."""

import struct
from pathlib import Path

import made_up_ethercat as made_up
import numpy as np
import pytest
from ethercat_robots import robot_text
from made_up_buses import robot_of

from acquisition.errors import BadInputError
from acquisition.importing import import_log
from acquisition.recording import read_recording

ROBOT = robot_of(robot_text())
REFUSED = bytes.fromhex("02000106")  # a write to a read-only object


def imported(tmp_path: Path, bus: made_up.Bus, packets=()):
    """Samples and warnings of 100 cycles of a bus, or of other `packets`."""
    path, out = tmp_path / "a.pcap", tmp_path / "a.mcap"
    path.write_bytes(made_up.pcap(packets or bus.packets(100)))
    found = import_log(path, out, ROBOT, "robot.toml")
    return read_recording(out).samples, found.warnings


def refusal(tmp_path: Path, bus: made_up.Bus) -> str:
    with pytest.raises(BadInputError) as caught:
        imported(tmp_path, bus)
    return str(caught.value)


def check(samples: np.ndarray, bus: made_up.Bus) -> None:
    """All rows have the true efforts, in per mille, and positions, in counts, of their cycles."""
    cycles = ((samples["stamp_ns"] - made_up.BEGIN_NS) // bus.period_ns).tolist()
    assert len(cycles) == 99
    for field, true, scale in (
        ("position", bus.position, 524_288 / (2 * np.pi)),
        ("effort", bus.effort, 1000.0),
    ):
        wanted = [[true(k, i) for i in range(2)] for k in cycles]
        assert np.rint(samples[field] * scale).astype(int).tolist() == wanted


OTHER = [(0x6077, 16), (0x6061, 8), (0, 8), (0x6064, 32), (0x6041, 16)]


class Remapped(made_up.Bus):
    """After its mapping the master writes another one, with the effort in place of the status."""

    def __init__(self, refused=(), lost=(), seconds=1, **options) -> None:
        super().__init__(**options)
        self.refused, self.lost, self.seconds = refused, lost, seconds
        self.count: dict[int, int] = {}

    def sdos(self):
        yield from super().sdos()
        for _ in range(self.seconds):
            yield struct.pack("<BHBI", 0x2F, 0x1A00, 0, 0)
            for k, (index, bits) in enumerate(OTHER, 1):
                yield struct.pack("<BHBI", 0x23, 0x1A00, k, index << 16 | bits)
            yield struct.pack("<BHBI", 0x2F, 0x1A00, 0, len(OTHER))

    def answer(self, station, sdo):
        k = self.count[station] = self.count.get(station, -1) + 1
        if k in self.lost:
            return None
        if k in self.refused:
            return b"\x80" + sdo[1:4] + REFUSED
        return super().answer(station, sdo)


FIRST = len(list(made_up.Bus().sdos()))  # SDO of a mapping; the second one has 7
SECOND = range(FIRST, FIRST + 7)


@pytest.mark.parametrize("seconds", [1, 2])
def test_refused_writes_do_not_count(tmp_path, seconds):
    bus = Remapped(refused=range(FIRST, FIRST + 14), seconds=seconds)
    samples, warnings = imported(tmp_path, bus)
    check(samples, bus)
    assert warnings == ()


def test_later_confirmed_mapping_counts(tmp_path):
    class Other(Remapped):
        def inputs(self, k, i):
            return struct.pack("<hBxiH", self.effort(k, i), 8, self.position(k, i), 0x1237)

    bus = Other()
    check(imported(tmp_path, bus)[0], bus)


@pytest.mark.parametrize(
    ("bus", "expected"),
    [
        # the last two of the second mapping
        (Remapped(lost=[FIRST + 5]), "1001: 1A00:5 was written, but no answer was seen"),
        (Remapped(lost=[FIRST + 6]), "1001: 1A00:0 was written, but no answer was seen"),
        (
            Remapped(refused=[FIRST - 5], seconds=0),  # four come after it
            "1001: 1A00:5 was refused by the drive (0x06010002)",
        ),
    ],
)
def test_unconfirmed_mapping_is_refused(tmp_path, bus, expected):
    assert f"station {expected}" in refusal(tmp_path, bus)


def test_answers_of_other_slave_do_not_confirm(tmp_path):
    class Other(made_up.Bus):
        def answer(self, station, sdo):
            return super().answer(station, sdo) if station == 1001 else None

    assert "station 1002: 1C13:0 was written, but no answer" in refusal(tmp_path, Other())


def test_unwritten_entries_are_refused(tmp_path):
    class More(made_up.Bus):
        def sdos(self):
            for sdo in super().sdos():  # the number of entries is one too many
                more = sdo[1:4] == b"\x00\x1a\x00" and sdo[4] > 0
                yield sdo[:4] + bytes([sdo[4] + more]) + sdo[5:]

    assert "station 1001: 1A00:6 is not known" in refusal(tmp_path, More())


def test_without_answers_writes_count_with_warning(tmp_path):
    bus = made_up.Bus(answers=False)
    samples, warnings = imported(tmp_path, bus)
    check(samples, bus)
    assert warnings == (
        "the capture contains no answers of slaves: the mapping is what the master wrote",
    )


def mail(bus: made_up.Bus, time_ns: int, sdo: bytes, *, answer: bool, service: int = 2) -> list:
    """A mail of the first slave or to it, out and back."""
    data = (struct.pack("<HHBBH", 10, 0, 0, 0x13, service << 12) + sdo).ljust(128, b"\0")
    command, at = (made_up.FPRD, 0x1080) if answer else (made_up.FPWR, 0x1000)
    address = bus.stations[0] | at << 16
    return [
        (time_ns, bus.frame(True, [(command, address, bytes(128) if answer else data, 0)], 0)),
        (time_ns + made_up.BACK_NS, bus.frame(False, [(command, address, data, 1)], 0)),
    ]


WRITE = struct.pack("<BHBI", 0x23, 0x1A00, 5, 0x60410010)
IN_OPERATION = made_up.BEGIN_NS + 50_400_000


@pytest.mark.parametrize(("service", "abort"), [(2, b"\x80"), (1, b"\x60"), (8, b"\x60")])
def test_refused_sdo_in_operation_keeps_rows(tmp_path, service, abort):
    bus = made_up.Bus()
    packets = bus.packets(100) + mail(bus, IN_OPERATION, WRITE, answer=False, service=service)
    packets += mail(
        bus, IN_OPERATION + 200_000, abort + WRITE[1:4] + REFUSED, answer=True, service=service
    )
    samples, warnings = imported(tmp_path, bus, sorted(packets))
    check(samples, bus)
    assert warnings == ()


def test_one_answer_makes_others_required(tmp_path, monkeypatch):
    """The capture is read in parts: without an answer so far, writes had counted."""
    monkeypatch.setattr("acquisition.importing.captures._AT_ONCE", 20_000)
    bus, read = made_up.Bus(answers=False), struct.pack("<BHBI", 0x43, 0x1600, 1, 0x60400010)
    packets = bus.packets(200) + mail(bus, IN_OPERATION + 50_000_000, read, answer=True, service=3)
    with pytest.raises(BadInputError, match="1C13:0 was written, but no answer was seen"):
        imported(tmp_path, bus, sorted(packets))
