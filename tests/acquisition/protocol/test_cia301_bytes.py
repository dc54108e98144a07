"""CiA 301 byte for byte: identifiers, SDO, PDO parameters, NMT, heartbeats, emergencies;
every frame typed by hand.
"""

import pytest
from dry_sessions import Answering
from made_up_buses import bus_of, bus_text, robot_of

from acquisition import protocol
from acquisition.bus import Frame, Master
from acquisition.errors import BadInputError, NoAnswerError, SdoAbortedError
from acquisition.protocol import ObjectEntry, State, answer_of, pdos_of, write_request
from acquisition.simulated import SimulatedDrives

STATUS, POSITION, TORQUE = (
    ObjectEntry(index=0x6041, sub=0, type="U16"),
    ObjectEntry(index=0x6064, sub=0, type="I32"),
    ObjectEntry(index=0x6074, sub=0, type="I16"),
)
INTERPOLATION = ObjectEntry(index=0x60C2, sub=2, type="I8")


def data(text: str) -> bytes:
    return bytes.fromhex(text)


@pytest.mark.parametrize(
    ("text", "kind", "key", "value"),
    [
        ("4F 61 60 00 08 AA AA AA", "value", (0x6061, 0), 8),
        ("4B 41 60 00 37 12 AA AA", "value", (0x6041, 0), 0x1237),
        ("47 00 20 03 01 02 03 AA", "value", (0x2000, 3), 0x030201),
        ("43 00 10 00 92 01 02 80", "value", (0x1000, 0), 0x80020192),
        ("42 00 10 00 92 01 02 80", "value", (0x1000, 0), 0x80020192),
        ("60 40 60 00 00 00 00 00", "written", (0x6040, 0), 0),
        ("80 00 20 00 00 00 02 06", "abort", (0x2000, 0), 0x06020000),
        ("41 08 10 00 0A 00 00 00", "other", (0x1008, 0), 0),  # 10 bytes, which follow
    ],
)
def test_sdo_answers_read(text, kind, key, value):
    found = answer_of(data(text))
    assert (found.kind, (found.index, found.sub), found.number) == (kind, key, value)


def test_other_sdo_answers():
    assert (
        protocol.check_answer(answer_of(data("4B 41 60 00 37 12 00 00")), "value", 5, "x") == 0x1237
    )
    with pytest.raises(NoAnswerError) as unasked:
        protocol.check_answer(answer_of(data("60 41 60 00 00 00 00 00")), "value", 5, "x")
    assert (unasked.value.node, unasked.value.place, unasked.value.text) == (
        5,
        "x",
        "the drive answered 'written' instead of 'value'",
    )
    with pytest.raises(SdoAbortedError) as aborted:
        protocol.check_answer(answer_of(data("80 41 60 00 01 00 00 FF")), "value", 5, "x")
    assert (aborted.value.code, aborted.value.meaning) == (0xFF000001, "abort")
    with pytest.raises(SdoAbortedError) as known:
        protocol.check_answer(answer_of(data("80 00 20 00 00 00 02 06")), "value", 5, "x")
    assert (known.value.node, known.value.index, known.value.meaning) == (
        5,
        0x2000,
        "object does not exist",
    )


@pytest.mark.parametrize(
    ("direction", "expected"),
    [("tpdo", [0x185, 0x285, 0x385, 0x485, None]), ("rpdo", [0x205, 0x305, 0x405, 0x505, None])],
)
def test_predefined_connection_set_identifiers(direction, expected):
    assert [protocol.usual_can_id(direction, number, 5) for number in (1, 2, 3, 4, 5)] == expected


@pytest.mark.parametrize(
    ("raw", "bits", "number"),
    [
        (0xFA, 8, -6),
        (0x7FFF, 16, 32767),
        (0x8000, 16, -32768),
        (0xFFFF, 32, 65535),
        (0xFFFFFFFF, 32, -1),
    ],
)
def test_signed_integers_are_twos_complements(raw, bits, number):
    assert protocol.signed(raw, bits) == number


TPDO = protocol.Pdo(number=1, can_id=0x185, entries=(STATUS, POSITION, TORQUE))
RPDO = protocol.Pdo(
    number=3, can_id=0x405, entries=(ObjectEntry(index=0x6040, sub=0, type="U16"), INTERPOLATION)
)


@pytest.mark.parametrize(
    ("direction", "pdo", "frames"),
    [
        ("tpdo", TPDO,
         ["23 00 18 01 85 01 00 80", "2F 00 18 02 01 00 00 00", "2F 00 1A 00 00 00 00 00",
          "23 00 1A 01 10 00 41 60",
          "23 00 1A 02 20 00 64 60", "23 00 1A 03 10 00 74 60", "2F 00 1A 00 03 00 00 00",
          "23 00 18 01 85 01 00 00"]),
        ("rpdo", RPDO,
         ["23 02 14 01 05 04 00 80", "2F 02 14 02 01 00 00 00", "2F 02 16 00 00 00 00 00",
          "23 02 16 01 10 00 40 60",
          "23 02 16 02 08 02 C2 60", "2F 02 16 00 02 00 00 00", "23 02 14 01 05 04 00 00"]),
    ],
)  # fmt: skip
def test_pdo_configuration_bytes(direction, pdo, frames):
    """Off, at every SYNC, no objects, the objects, their number, on: CiA 301, 7.5.2.38."""
    assert [
        write_request(*write).hex(" ").upper() for write in protocol.configuration(direction, pdo)
    ] == frames


@pytest.mark.parametrize(
    ("answer", "data"),
    [
        ("42 17 10 00 64 00 A5 A5", "64 00"),  # U16
        ("42 01 18 02 FF A5 A5 A5", "FF"),  # U8: transmission type
        ("42 00 1A 00 03 A5 A5 A5", "03"),  # U8: count of a mapping
        ("42 00 1A 01 10 00 41 60", "10 00 41 60"),
        ("42 5A 68 00 FE FF A5 A5", "FE FF"),  # I16 of the second axis
        ("42 08 10 00 73 69 6D 00", "73 69 6D 00"),  # a name of four bytes
        ("42 05 10 00 80 00 00 40", "80 00 00 40"),
        ("42 64 60 00 01 02 03 04", "01 02 03 04"),
        ("42 01 20 01 01 02 03 04", "01 02 03 04"),  # not known here
        ("43 17 10 00 64 00 A5 A5", "64 00"),
        ("4B 01 20 01 01 02 00 00", "01 02"),
    ],
)
def test_value_without_size_has_type_size(answer, data):
    """Unless the drive has stated a size below four bytes for another object."""
    frame, sized = bytes.fromhex(answer), bytes.fromhex("4B 41 60 00 40 02 00 00")
    link = Answering(
        lambda can_id, request: [(0x581, frame if request[1:4] == frame[1:4] else sized)]
    )
    master = Master(link, bus_of(robot_of(bus_text(1))))
    index, sub = frame[2] << 8 | frame[1], frame[3]
    assert master.upload(1, index, sub).data == bytes.fromhex(data)
    assert master.read(1, 0x6041) == 0x240
    if answer[1] in "23":
        assert master.upload(1, index, sub).data == frame[4:]


TPDO_VALUES = {
    (0x1801, 1): 0x40000285,  # bit 30: no remote requests
    (0x1A01, 0): 3, (0x1A01, 1): 0x60410010, (0x1A01, 2): 0x60C20208, (0x1A01, 3): 0x60640020,
    (0x1A01, 4): 0x60770010,  # beyond the number of objects
}  # fmt: skip
KINDS = {(0x6041, 0): "U16", (0x60C2, 2): "I8", (0x6064, 0): "I32", (0x6077, 0): "I16"}


def test_pdos_from_drive_parameters():
    expected = protocol.Pdo(number=2, can_id=0x285, entries=(STATUS, INTERPOLATION, POSITION))
    assert pdos_of("tpdo", TPDO_VALUES, KINDS, "x") == (expected,)
    assert pdos_of("rpdo", TPDO_VALUES, KINDS, "x") == ()
    of_29_bits = pdos_of("tpdo", TPDO_VALUES | {(0x1801, 1): 0x20000285}, KINDS, "x")
    # distinguished from 285h, so that it is refused
    assert [pdo.can_id for pdo in of_29_bits] == [0x20000285]
    last = {(0x15FF, 1): 0x301, (0x17FF, 0): 1, (0x17FF, 1): 0x60410010}
    assert [(pdo.number, pdo.can_id) for pdo in pdos_of("rpdo", last, KINDS, "x")] == [(512, 0x301)]


@pytest.mark.parametrize(
    "change", [{(0x1801, 1): 0x80000285}, {(0x1801, 1): 0}, {(0x1A01, 0): 0}, {(0x1801, 1): None}]
)
def test_disabled_pdos(change):
    values = {key: value for key, value in (TPDO_VALUES | change).items() if value is not None}
    assert pdos_of("tpdo", values | {(0x1801, 2): 1}, KINDS, "x") == ()


def test_objects_in_pdos_by_bits():
    unknown = {(0x1800, 1): 0x185, (0x1A00, 0): 2, (0x1A00, 1): 0x20000120, (0x1A00, 2): 0}
    (pdo,) = pdos_of("tpdo", unknown, {}, "x")
    # the second place is empty
    assert pdo.entries == (ObjectEntry(index=0x2000, sub=1, type="U32"),)
    for word in (0x60640010, 0x20000101, 0x200001FF):
        with pytest.raises(BadInputError) as caught:
            pdos_of("tpdo", unknown | {(0x1A00, 1): word}, KINDS, "x")
        assert caught.value.expected == "whole bytes, as many as the object has"


def test_values_in_frame():
    values = {(0x6041, 0): 0x9237, (0x6064, 0): -5, (0x6074, 0): -300}
    assert TPDO.pack(values) == data("37 92 FB FF FF FF D4 FE")
    # what is beyond belongs to nobody
    assert TPDO.unpack(data("37 92 FB FF FF FF D4 FE 00")) == values
    with pytest.raises(
        BadInputError, match="PDO 0x185: the frame has 7 bytes: expected at least 8"
    ):
        TPDO.unpack(data("37 92 FB FF FF FF D4"))
    assert [TPDO.offset(0x6041, 0), TPDO.offset(0x6064, 0), TPDO.offset(0x6074, 0)] == [0, 2, 6]
    assert (TPDO.bits, TPDO.length) == (64, 8)


def test_bits_on_wire():
    """47 of frame and gap, 8 for each byte, and a stuffing bit for four of the 34 + 8
    n - 1 that are stuffed.
    """
    assert [protocol.frame_bits(n) for n in range(9)] == [55, 65, 75, 85, 95, 105, 115, 125, 135]


@pytest.mark.parametrize(
    ("period_s", "expected"),
    [(0.001, (1, -3)), (0.004, (4, -3)), (0.255, (255, -3)), (0.0005, (5, -4)),
     (0.0125, (125, -4)), (0.00025, (25, -5)),
     (0.000125, (125, -6))],
)  # fmt: skip
def test_interpolation_period_60c2(period_s, expected):
    assert protocol.interpolation_period(period_s) == expected


@pytest.mark.parametrize("period_s", [0.256, 0.0003333, 1e-7])
def test_periods_not_representable_in_60c2(period_s):
    with pytest.raises(BadInputError, match=r"bus.sync_period_s = .*60C2"):
        protocol.interpolation_period(period_s)


ROBOT = robot_of(bus_text(1).replace("node = 1\n", "node = 5\n"))
BUS = bus_of(ROBOT)


@pytest.fixture
def node():
    return SimulatedDrives(ROBOT, BUS).nodes[0]


def written(node, *frames: str) -> None:
    for frame in frames:
        ((can_id, answer),) = node.receive(0x605, data(frame))
        assert (can_id, answer) == (0x585, data("60") + data(frame)[1:4] + bytes(4)), frame


MAPPED = (
    "23 00 14 01 05 02 00 80", "2F 00 16 00 00 00 00 00", "23 00 16 01 10 00 40 60",
    "23 00 16 02 20 00 7A 60",
    "2F 00 16 00 02 00 00 00", "2F 00 14 02 01 00 00 00", "23 00 14 01 05 02 00 00",
    "23 00 1A 01 10 00 41 60",
    "2F 00 1A 00 01 00 00 00", "23 00 18 01 85 01 00 00",
)  # fmt: skip


def commanded(node, control: str) -> str:
    """A controlword by RPDO, SYNC, and the statusword of the TPDO after the next SYNC."""
    assert node.receive(0x205, data(control + "00 00 00 00")) == []
    node.apply()
    node.tick()
    ((can_id, answer),) = node.answers()
    assert can_id == 0x185
    return answer.hex(" ")


def test_boot_up_and_heartbeats(node):
    assert node.boot() == [(0x705, data("00"))]
    assert node.heartbeat() == [(0x705, data("7F"))]
    for command, expected in (
        ("01 05", "05"),
        ("02 05", "04"),
        ("80 00", "7F"),
        ("01 00", "05"),
        ("02 06", "05"),
    ):
        assert node.receive(0x000, data(command)) == []
        assert node.heartbeat() == [(0x705, data(expected))]
    for command in ("81 05", "82 05", "81 00"):
        assert node.receive(0x000, data(command)) == [(0x705, data("00"))]
        assert node.heartbeat() == [(0x705, data("7F"))]
    assert node.receive(0x000, data("01")) == []
    assert node.heartbeat() == [(0x705, data("7F"))]


def test_reset_clears_values_mapping_and_state(node):
    written(node, *MAPPED, "2F 60 60 00 08 00 00 00")
    node.receive(0x000, data("01 05"))
    commanded(node, "06 00")
    assert node.receive(0x000, data("81 05")) == [(0x705, data("00"))]
    assert (node.tpdos, node.rpdos, node.state) == ((), (), State.SWITCH_ON_DISABLED)
    assert node.receive(0x605, data("40 60 60 00 00 00 00 00")) == [
        (0x585, data("4F 60 60 00 00 00 00 00"))
    ]
    assert node.receive(0x605, data("40 00 14 01 00 00 00 00")) == [
        (0x585, data("43 00 14 01 00 00 00 80"))
    ]


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("40 41 60 00 00 00 00 00", "4B 41 60 00 50 02 00 00"),
        ("40 00 10 00 00 00 00 00", "43 00 10 00 92 01 02 00"),
        ("40 61 60 00 00 00 00 00", "4F 61 60 00 FF 00 00 00"),  # the mode asked for is displayed
        ("40 55 55 00 00 00 00 00", "80 55 55 00 00 00 02 06"),
        ("40 18 10 09 00 00 00 00", "80 18 10 09 11 00 09 06"),
        ("23 00 1A 01 20 00 41 60", "80 00 1A 01 41 00 04 06"),  # 6041 has 16 bits, not 32
        ("23 00 1A 01 10 00 55 55", "80 00 1A 01 41 00 04 06"),
        ("21 10 10 01 40 00 00 00", "80 00 00 00 01 00 04 05"),
    ],
)
def test_sdo_answers_of_node(node, asked, answer):
    written(node, "2F 60 60 00 FF 00 00 00")
    assert node.values[0x6061, 0] == -1
    assert node.receive(0x605, data(asked)) == [(0x585, data(answer))]
    assert node.receive(0x606, data(asked)) == []
    node.receive(0x000, data("02 05"))  # stopped: NMT and heartbeats only
    assert node.receive(0x605, data(asked)) == []


def test_mapping_is_refused_as_in_cia_301(node):
    written(node, *MAPPED[:5], "2F 00 14 02 01 00 00 00")
    objects_are_counted = node.receive(0x605, data("23 00 16 01 10 00 40 60"))
    assert objects_are_counted == [(0x585, data("80 00 16 01 22 00 00 08"))]
    written(node, "23 00 14 01 05 02 00 00")
    assert node.receive(0x605, data("2F 00 16 00 00 00 00 00")) == [
        (0x585, data("80 00 16 00 22 00 00 08"))
    ]
    long = ("23 01 1A 01 20 00 64 60", "23 01 1A 02 20 00 64 60", "23 01 1A 03 08 00 61 60")
    written(node, *long)
    assert node.receive(0x605, data("2F 01 1A 00 03 00 00 00")) == [
        (0x585, data("80 01 1A 00 42 00 04 06"))
    ]
    written(node, "2F 01 1A 00 02 00 00 00")  # 64 bits just fit
    written(node, "23 02 1A 01 08 01 C2 60", "23 02 1A 02 08 02 C2 60")  # both parts of 60C2h
    assert node.receive(0x605, data("23 02 1A 03 08 03 C2 60")) == [
        (0x585, data("80 02 1A 03 41 00 04 06"))
    ]


def test_controlword_bits_move_node_state(node):
    """Beside the state's own bits: voltage present (4), remote (9), and, enabled in CSP,
    following the command (12).
    """
    written(node, *MAPPED)
    assert node.receive(0x205, data("06 00 00 00 00 00")) == []  # not operational: no PDO is taken
    node.apply()
    assert node.answers() == []
    node.receive(0x000, data("01 05"))
    for control, status in (
        ("00 00", "50 02"),  # switch on disabled
        ("0f 00", "50 02"),  # illegal there
        ("06 00", "31 02"), ("07 00", "33 02"), ("0f 00", "37 12"),
        ("02 00", "17 02"), ("02 00", "17 02"),  # quick stop active, and it stays so
        ("0f 00", "37 12"), ("02 00", "17 02"), ("00 00", "50 02"),
    ):  # fmt: skip
        assert commanded(node, control) == status
    assert node.emergency(0x8700) == [(0x085, data("00 87 01 00 00 00 00 00"))]
    assert node.statusword & 0x4F == 0x0F
    node.tick()
    # fault, reset
    assert [commanded(node, control) for control in ("0f 00", "80 00")] == ["18 02", "50 02"]
    node.emergency(0x2310)
    node.tick()
    # Bit 7 was not low in between: no rising edge.
    assert [commanded(node, control) for control in ("80 00", "8f 00", "00 00", "80 00")] == [
        "18 02"
    ] * 3 + ["50 02"]


def test_leaving_operational_removes_torque(node):
    written(node, *MAPPED)
    node.receive(0x000, data("01 05"))
    for word in ("06 00", "07 00", "0f 00"):
        commanded(node, word)
    assert node.state is State.OPERATION_ENABLED
    node.receive(0x000, data("80 05"))
    assert node.state is not State.OPERATION_ENABLED
    assert node.answers() == []


def test_rpdo_acts_by_transmission_type(node):
    written(node, *MAPPED)
    node.receive(0x000, data("01 05"))
    node.receive(0x205, data("06 00 FE FF FF FF"))
    assert node.values[0x607A, 0] == 0
    node.apply()
    assert node.values[0x607A, 0] == -2
    node.receive(0x205, data("06 00 FE FF FF"))  # too short
    node.apply()
    assert node.values[0x607A, 0] == -2
    node.receive(0x205, data("06 00 05 00 00 00"))
    node.receive(0x205, data("06 00 07 00 00 00"))  # the last before SYNC counts
    node.apply()
    assert node.values[0x607A, 0] == 7
    written(node, "2F 00 14 02 FF 00 00 00")
    node.receive(0x205, data("06 00 03 02 01 00"))
    assert node.values[0x607A, 0] == 0x010203
    written(node, "2F 00 14 02 F0 00 00 00")  # 240 is the last synchronous one
    node.receive(0x205, data("06 00 00 00 00 00"))
    assert node.values[0x607A, 0] == 0x010203


def test_master_reads_and_writes():
    answers = {
        data("40 41 60 00 00 00 00 00"): [
            (0x586, data("4B 41 60 00 11 11 00 00")),  # of another node
            (0x585, data("4B 40 60 00 22 22 00 00")),  # to another question
            (0x585, data("4B 41 60 00 37 12 00 00")),
        ],
        data("2B 40 60 00 06 00 00 00"): [(0x585, data("60 40 60 00 00 00 00 00"))],
        data("40 00 10 00 00 00 00 00"): [(0x585, data("80 00 10 00 00 00 00 08"))],
    }
    link = Answering(lambda can_id, asked: answers.get(asked, []))
    master = Master(link, BUS)
    assert master.read(5, 0x6041) == 0x1237
    master.write(5, 0x6040, 0, 6, 2)
    for index, kind in ((0x1000, SdoAbortedError), (0x1001, NoAnswerError)):
        with pytest.raises(kind) as caught:
            master.read(5, index)
        assert (caught.value.node, caught.value.place) == (5, f"node 5: object {index:04X}:0")
    assert link.sent[:2] == [
        (0x605, data("40 41 60 00 00 00 00 00")),
        (0x605, data("2B 40 60 00 06 00 00 00")),
    ]
    link.sent.clear()
    master.nmt(0x81, 5)
    master.sync()
    assert link.sent == [(0, b"\x81\x05"), (0x80, b"")]


def test_master_takes_emergencies_and_pdos():
    master = Master(Answering(), BUS)
    watch = master.nodes[0]
    master.dispatch(Frame(0, 0x086, data("10 23 01 00 00 00 00 00")))
    master.dispatch(Frame(0, 0x085, data("00 00 00 00 00 00 00 00")))  # no error any more
    assert watch.emergency is None
    master.dispatch(Frame(0, 0x085, data("10 23 02 00 00 00 00 00")))
    assert watch.emergency == 0x2310
    master.dispatch(Frame(0, 0x705, data("FF")))  # its toggle bit is no state
    assert (watch.nmt, watch.booted) == (127, False)
    master.dispatch(Frame(0, 0x185, data("37 12 FB FF FF FF D4")))  # too short
    assert (watch.statusword, watch.counts, watch.answers) == (None, None, 0)
    master.dispatch(Frame(0, 0x185, data("37 12 FB FF FF FF D4 FE")))
    assert (watch.statusword, watch.counts, watch.answers) == (0x1237, -5, 1)
    assert watch.state is State.OPERATION_ENABLED
