"""`robot-acquire scan`: reads only, silent beside another master, what odd nodes say, a `[bus]`
that check and record take.
"""

import itertools
import re
import time
from collections import Counter
from dataclasses import dataclass, field

import pytest
from dry_sessions import Answering, FaultyDrives, Through, connected, swing
from made_up_buses import bus_of, bus_text, robot_of
from virtual_buses import Ear, bus_file, served

from acquisition.bus import Frame, Master, Uploads, scan_nodes, upload_segments
from acquisition.commands import main
from acquisition.commands.scanning import ARRAYS, OBJECTS, bus_lines, findings_of
from acquisition.errors import RefusedError
from acquisition.protocol import abort_answer, value_answer
from acquisition.recording import ERROR, REMOTE_REQUEST, read_recording
from acquisition.robot import lines_to_fill_in
from acquisition.simulated import LockStepLink

SEGMENTS = b"\x60" + bytes(7), b"\x70" + bytes(7)  # requests for the next part of a text
IDENTITY = {
    (0x1018, sub): value for sub, value in ((1, 0xFB), (2, 0x60500000), (3, 0x1700010), (4, 77))
}


def scan(channel: str, *options: str) -> int:
    return main(["scan", "--interface", "virtual", "--channel", channel, *options])


def is_upload(frame: Frame) -> bool:
    """An SDO request of CiA 301 to read: command 40h, nothing behind index and sub-index;
    or 60h, 70h and nothing.
    """
    reads = (frame.data[:1] == b"\x40" and frame.data[4:] == bytes(4)) or frame.data in SEGMENTS
    return 0x601 <= frame.can_id <= 0x67F and reads


def test_scan_of_six_drives_only_reads(tmp_path, capsys):
    out = tmp_path / "bus.toml"
    with served("scan_six", 6):
        ear, started_s = Ear("scan_six"), time.monotonic()
        assert scan("scan_six", "--toml", str(out)) == 0
        assert time.monotonic() - started_s < 6
    frames = ear.frames()
    from_drives = {base + node for base in (0x580, 0x700) for node in range(1, 7)}
    sent = [frame for frame in frames if frame.can_id not in from_drives]
    assert len(sent) > 127 + 6 * 40
    assert all(is_upload(frame) for frame in sent)
    device_type = [frame.can_id for frame in sent if frame.data[1:4] == b"\x00\x10\x00"]
    assert device_type[:127] == list(range(0x601, 0x680))
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith("ok") and "1, 2, 3, 4, 5, 6" in line for line in lines[:-1])
    assert lines[-1] == f"{out}: complete the 13 lines marked FILL IN"
    assert (
        out.read_text().count("counts_per_turn = 65536 # FILL IN: turn the motor once to check")
        == 6
    )


def test_scan_listens_first_and_spaces_requests():
    frames, robot = list[Frame](), robot_of(bus_text(2))
    link = LockStepLink(FaultyDrives(robot, bus_of(robot)), tap=frames.append)
    started_ns = link.now_ns()
    scan_nodes(Uploads(link, bus_file()), OBJECTS, ARRAYS)
    times = [frame.time_ns for frame in frames if 0x600 < frame.can_id < 0x680]
    assert times[0] - started_ns >= 500_000_000
    assert min(b - a for a, b in itertools.pairwise(times)) >= 1_000_000
    assert times[126] - times[0] < 200_000_000  # the answers are awaited together


def drives_of(n: int, kind: type[FaultyDrives] = FaultyDrives) -> LockStepLink:
    return connected(robot_of(bus_text(n)), kind)[0]


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\x82\x00",
        b"\x40\x41\x60\x00" + bytes(3),
        b"\x2b\x40\x60\x00\x06" + bytes(3),
        b"\x61" + bytes(7),
    ],
)
@pytest.mark.parametrize("can_id", [0x000, 0x080, 0x201, 0x581, 0x600, 0x601, 0x680, 0x77F])
def test_only_reads_can_be_sent(can_id, frame):
    if can_id != 0x601:
        # a read, but to an identifier of another service
        frame = frame or b"\x40\x41\x60\x00" + bytes(4)
    link = Answering()
    with pytest.raises(RefusedError, match="is not an SDO read"):
        Uploads(link, bus_file()).send(can_id, frame)
    assert link.sent == []


@dataclass(kw_only=True)
class Sudden(Through):
    """Sends one frame as soon as `after` frames were sent; holds it until the scan receives
    again, as a socket does.
    """

    frame: Frame | None
    after: int
    sent: list[tuple[int, bytes]] = field(default_factory=list)

    def send(self, can_id, data):
        self.sent.append((can_id, data))
        super().send(can_id, data)

    def receive(self, until_ns):
        if self.frame is None or len(self.sent) < self.after:
            return super().receive(until_ns)
        self.frame, frame = None, self.frame
        return frame


BEGUN = "; {} SDO reads were sent. Scan only a bus"
WRONG = "the bus has errors .no acknowledgement.*bit rate"


@pytest.mark.parametrize(
    ("frame", "after", "told", "for_good"),
    [
        *(
            (
                Frame(0, *master),
                0,
                "; nothing was sent. Scan only a bus",
                "another master is active",
            )
            for master in ((0x000, b"\x01\x00"), (0x080, b""), (0x605, bytes(8)), (0x201, bytes(6)))
        ),
        *(
            (Frame(0, 0x80, b""), after, BEGUN, "another master is active")
            for after in (1, 60, 127, 128, 150, 200)
        ),
        *(
            (Frame(0, 0x701, b"", REMOTE_REQUEST), after, BEGUN, "another master is active")
            for after in (1, 150)
        ),
        *((Frame(0, 0x20, bytes(8), ERROR), after, WRONG, WRONG) for after in (0, 30, 140)),
    ],
)
def test_other_master_or_error_frame_ends_scan(frame, after, told, for_good):
    link = Sudden(link=drives_of(2), frame=frame, after=after)
    uploads = Uploads(link, bus_file())
    with pytest.raises(RefusedError, match=told.format(after)):
        scan_nodes(uploads, OBJECTS, ARRAYS)
    for _ in range(2):
        with pytest.raises(RefusedError, match=for_good):
            uploads.send(0x601, b"\x40\x00\x10" + bytes(5))
    assert len(link.sent) == after


class Odd(FaultyDrives):
    """Drives whose answers to some reads are others: by node and object, the frame or None."""

    answers: dict[tuple[int, int, int], bytes | None]
    asked: Counter[tuple[int, int, int]]

    def receive(self, now_ns, can_id, data):
        sent = super().receive(now_ns, can_id, data)
        key = (
            (can_id - 0x600, int.from_bytes(data[1:3], "little"), data[3])
            if len(data) == 8
            else (0, 0, 0)
        )
        self.asked[key] += 1
        if key in self.answers:
            answer = self.answers[key]
            return [] if answer is None else [(0x580 + key[0], answer)]
        return sent


def odd(n: int, answers: dict[tuple[int, int, int], bytes | None], kind: type[Odd] = Odd):
    link = drives_of(n, kind)
    link.drives.answers, link.drives.asked = answers, Counter()
    uploads = Uploads(link, bus_file())
    nodes = scan_nodes(uploads, OBJECTS, ARRAYS)
    return nodes, uploads.heard, link.drives


def row(nodes, heard, subject, node):
    (found,) = [f for f in findings_of(nodes, heard) if (f.subject, f.node) == (subject, node)]
    return found


def test_invalid_answers_are_shown():
    answers = {
        (1, 0x6075, 0): abort_answer(0x6075, 0, "general error"),
        (1, 0x6092, 1): abort_answer(0x6092, 1, "object does not exist"),
        (1, 0x6041, 0): value_answer(0x6041, 0, 0x250, 4),
        (1, 0x6064, 0): value_answer(0x6064, 0, -5, 2),
        (1, 0x6502, 0): LONG,
        (1, 0x6080, 0): None,
        (2, 0x6074, 0): value_answer(0x6074, 0, 7, 4),
        (2, 0x607D, 1): value_answer(0x607D, 1, -70000, 4),
    }
    nodes, heard, drives = odd(2, answers)
    for node, subject, shown in (
        (
            1,
            "state",
            "6041 0x250 switch on disabled (4 bytes instead of 2), 6064 -5 (2 bytes instead of 4)",
        ),
        (1, "modes", "6502 (more than 4 bytes instead of 4)"),
        (1, "rated mA, mN m", "6075 (general error (0x08000000)), 6076 420"),
        (1, "units per turn", "6092:1 -, 6092:2 1, 6091:1 1, 6091:2 1, 608F:1 65536, 608F:2 1"),
        (1, "limits", "6080 (no answer)"),
        (2, "limits", "607D:1 -70000, "),
    ):
        assert shown in row(nodes, heard, subject, node).found
    assert drives.asked[1, 0x6080, 0] == 2
    bad = [
        {f.subject for f in findings_of(nodes, heard) if f.node == node and not f.ok}
        for node in (1, 2)
    ]
    assert bad == [{"state", "modes", "rated mA, mN m", "limits"}, {"efforts"}]
    written = list(bus_lines(bus_file(), nodes))
    efforts = [line.split(" #")[0] for line in written if line.startswith(("reference", "actual"))]
    # whatever 6074h is in the second, it is not CiA 402's
    assert efforts == ['reference = "6074"', 'actual = "6077"']


LONG = b"\x41\x02\x65\x00\x08\x00\x00\x00"  # the beginning of an upload of 8 bytes
BEGUN_TEXT = b"\x41\x08\x10\x00\x0a\x00\x00\x00"  # 10 bytes follow in segments


def test_invalid_or_missing_texts_are_shown():
    answers = {
        (1, 0x1009, 0): abort_answer(0x1009, 0, "object does not exist"),
        (1, 0x100A, 0): b"\x43\x0a\x10\x00v\xfc\n\x00",  # latin-1, and with a line feed
        (2, 0x1008, 0): BEGUN_TEXT,
        (2, 0, 0): abort_answer(0x1008, 0, "general error"),  # to the request for a segment
        (3, 0x1008, 0): BEGUN_TEXT,
        # the toggle bit of the second segment to the request for the first
        (3, 0, 0): b"\x10" + b"seconds",
    }
    nodes, heard, _ = odd(3, answers)
    assert row(nodes, heard, "name, versions", 1).found == '1008 "sim", 1009 -, 100A "v\ufffd\n"'
    for node, problem in ((2, "general error (0x08000000)"), (3, "no answer")):
        found = row(nodes, heard, "name, versions", node)
        assert (found.ok, found.found) == (False, f'1008 ({problem}), 1009 "none", 100A "none"')


def test_segmented_text_bytes():
    """CiA 301, 7.2.4.3.6: toggle bits, unused bytes of the last segment; then one answer
    more is another device's.
    """
    answers = [BEGUN_TEXT, b"\x00Drive 1", b"\x19B\xb03\0\0\0\0"]
    sent = []

    def answer(can_id, data):
        sent.append(data)
        return [(0x585, answers[len(sent) - 1])]

    master = Master(Answering(answer), bus_of(robot_of(bus_text(1))))
    assert master.upload(5, 0x1008).kind == "other"
    assert upload_segments(master, 5, 0x1008).data == b"Drive 1B\xb03"
    assert sent == [b"\x40\x08\x10\x00" + bytes(4), *SEGMENTS]
    master.dispatch(Frame(0, 0x585, value_answer(0x6041, 0, 0, 2)))
    assert master.doubled == {5}


def test_silent_node_does_not_delay_scan():
    silent = {
        (1, index, sub): None
        for index, sub in [*OBJECTS, *((index, 0) for index in ARRAYS)]
        if index != 0x1000
    }
    nodes, heard, drives = odd(2, silent)
    assert {reading.problem for reading in nodes[1].values() if reading.value is None} == {
        "no answer"
    }
    assert sum(count for (node, _, _), count in drives.asked.items() if node == 1) == 2 + 2 * 2
    assert row(nodes, heard, "drive", 1).found.startswith(
        "1000 0x20192, 1018:1 (no answer), 1018:2 (no answer)"
    )
    assert (row(nodes, heard, "PDOs", 1).found, row(nodes, heard, "PDOs", 1).ok) == (
        "no answer",
        False,
    )
    assert row(nodes, heard, "state", 2).ok
    assert (row(nodes, heard, "PDOs", 2).found, row(nodes, heard, "PDOs", 2).ok) == (
        "no PDO is mapped",
        True,
    )


def test_mapped_pdos_are_shown_of_silent_node():
    read = {(0x1800, 1): 0x181, (0x1A00, 0): 2, (0x1A00, 1): 0x60410010, (0x1A00, 2): 0x60640020,
            (0x1400, 1): 0x80000201, (0x1600, 0): 1, (0x1600, 1): 0x60400010,
            (0x1016, 2): 0x7F001E}  # fmt: skip
    nodes, heard, _ = odd(
        1, {(1, *key): value_answer(*key, value, 4 if key[1] else 1) for key, value in read.items()}
    )
    assert row(nodes, heard, "PDOs", 1).found == "tpdo 1 0x181 6041 6064; rpdo 1 0x201 off 6040"
    assert "1016 0x2, 1016:1 0x0, 1016:2 0x7F001E" in row(nodes, heard, "supervision", 1).found
    nodes, heard, _ = odd(
        1,
        {
            (1, 0x1800, 1): value_answer(0x1800, 1, 0x181, 4),
            (1, 0x1801, 1): None,
            (1, 0x1802, 1): None,
        },
    )
    assert row(nodes, heard, "PDOs", 1).found == "tpdo 1 0x181; no answer"


def test_other_devices_and_nodes_only_heard():
    answers = {
        (1, 0x1000, 0): value_answer(0x1000, 0, 0x00030191, 4),
        (1, 0x6041, 0): abort_answer(0x6041, 0, "object does not exist"),
        (2, 0x1000, 0): None,
        (3, 0x1000, 0): abort_answer(0x1000, 0, "general error"),  # a drive that names no profile
        **{(3, *key): value_answer(*key, value, 4) for key, value in IDENTITY.items()},
    }
    nodes, heard, _ = odd(3, answers)
    assert row(nodes, heard, "not a drive", 1).ok
    assert not row(nodes, heard, "only heard", 2).ok
    assert row(nodes, heard, "drive", 3).found.endswith(
        "1018:1 0xFB, 1018:2 0x60500000, 1018:3 0x1700010, 1018:4 0x4D"
    )
    lines = list(bus_lines(bus_file("can0", "socketcan"), nodes))
    assert any(
        re.fullmatch(r"bitrate = \d+ # FILL IN: copy it from ip link", line) for line in lines
    )
    assert [line for line in lines if line.startswith("other_nodes")] == [
        "other_nodes = [1] # nodes that are not drives"
    ]
    assert [line.split(" #")[0] for line in lines if line.startswith("node")] == ["node = 3"]


def all_answer(device: int = 0, silent: tuple[int, ...] = (), *heard: int) -> Answering:
    """A link to all node ids that are not in `silent`, each a device of type `device`;
    heartbeats of `heard`.
    """

    def answer(can_id, data):
        key = int.from_bytes(data[1:3], "little"), data[3]
        if can_id - 0x600 in silent:
            return []
        refused = abort_answer(*key, "object does not exist")
        return [(can_id - 0x80, value_answer(*key, device, 4) if key == (0x1000, 0) else refused)]

    link = Answering(answer)
    link.waiting = [(0x700 + node, b"\x7f") for node in heard]
    return link


NO_ID = "# master_node = ... # FILL IN: node id of this program; all are in use"


@pytest.mark.parametrize(
    ("link", "said"),
    [
        (all_answer(), NO_ID),
        (all_answer(0, (9, 5)), "master_node = 9 # node id of this program; no device uses it"),
        # 9 is heard only
        (all_answer(0, (9, 5), 9), "master_node = 5 # node id of this program; no device uses it"),
        (
            all_answer(0, tuple(range(2, 128)), 127, 126),
            "master_node = 125 # node id of this program; no device uses it",
        ),
        (all_answer(0, tuple(range(2, 128))), None),
    ],
)
def test_proposed_master_node_id_is_free(link, said, tmp_path, monkeypatch):
    monkeypatch.setattr("acquisition.bus.open_link", lambda *_, **__: link)
    assert scan("scan_all", "--toml", str(tmp_path / "bus.toml")) == 0
    lines = (tmp_path / "bus.toml").read_text().splitlines()
    assert [line for line in lines if "master_node" in line] == ([said] if said else [])


def described(bus: str, joints: int = 2) -> str:
    return bus_text(joints).split("[bus]")[0] + bus


@pytest.fixture(scope="module")
def scanned(tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("scanned") / "bus.toml"
    with served("scan_two", 2):
        assert scan("scan_two", "--toml", str(out)) == 0
    return out.read_text()


def test_scanned_file_is_no_go_until_filled_in(scanned, tmp_path, capsys):
    text, robot = described(scanned), tmp_path / "robot.toml"
    assert len(lines_to_fill_in(robot_of(text))) == 5
    assert lines_to_fill_in(robot_of(described(re.sub(" *# FILL IN.*", "", scanned)))) == []
    robot.write_text(text)
    with served("scan_two", 2):
        assert main(["check", str(robot)]) == 1
    out, err = capsys.readouterr()
    # On a busy machine SYNC is uneven, which forbids any session.
    assert re.search("check for --track failed: .*FILL IN|check failed: .*FILL IN.*SYNC", err)
    assert re.search(r"ok      rated value 6076:0 +1, 2 +420\n", out)


@pytest.mark.parametrize(
    ("change", "refused"),
    [
        (("", ""), "marked FILL IN. Complete them"),
        (
            ("", 'unconfirmed = ["joint_2"]\n'),
            "robot.toml: unconfirmed = 'joint_2': these joints were corrected from a recording, "
            "and no person has checked them. Move each of them by hand",
        ),
    ],
)
def test_track_refuses_incomplete_or_unconfirmed(
    scanned, tmp_path, capsys, monkeypatch, change, refused
):
    (tmp_path / "robot.toml").write_text(described(scanned).replace(*change, 1))
    path = swing(2, seconds=0.4, amplitude=0.02)
    rows = [f"{0.002 * k},{q[0]},{q[1]}" for k, q in enumerate(path)]
    (tmp_path / "ref.csv").write_text("\n".join(["time_s,joint_1,joint_2", *rows]))
    monkeypatch.chdir(tmp_path)
    command = ["record", "robot.toml", "--track", "ref.csv", "-o", "log.mcap"]
    ear = Ear("scan_two")
    assert main([*command, "--yes"]) == 1
    assert refused in capsys.readouterr().err
    assert ear.frames() == []
    assert not (tmp_path / "log.mcap").exists()
    assert main([*command, "--dry-run", "--no-fit"]) == 0
    stored = read_recording(tmp_path / "log.mcap").robot.files["robot.toml"].decode()
    assert stored == (tmp_path / "robot.toml").read_text()


def test_only_marks_of_motion_keys_count():
    marked = "[controller] # FILL IN\nbandwidth_hz = 5 # FILL IN"
    text = (
        bus_text(1).replace("[controller]\nbandwidth_hz = 5", marked)
        + "\n[parameters] # FILL IN\nM1 = 1 # FILL IN\n"
    )
    assert lines_to_fill_in(robot_of(text)) == []
    number = text[: text.index("node = 1")].count("\n") + 1
    assert lines_to_fill_in(robot_of(text.replace("node = 1", "node = 1 # FILL IN"))) == [number]


@pytest.mark.parametrize(
    ("line", "marks", "counts"),
    [
        ("ratio = 50.0", "ratio = 50.0 # FILL IN: sign included", [1]),
        ("ratio = 50.0", "# ratio = ... # FILL IN: none for efforts at the joint", [1]),
        ("[[motor]]", "\n# FILL IN: for each motor\n#     ratio = 100\n[[motor]]", [2]),
        ("[bus]", "\n# FILL IN: the drives.\n# FILL IN: all of them\n[bus]", [2, 3]),
        ("[bus]", "# FILL IN: of what stands above\n\n[bus]", [1]),  # in [[motor]]
        ("speed_deg_s = 200", "# speed_deg_s = ... # FILL IN: the URDF has no speed", [1]),
        ("speed_deg_s = 200", "speed_deg_s = 200 # FILL IN", [1]),
        ("speed_deg_s = 200", "# effort_nm = ... # FILL IN: the URDF has no effort", []),
        ("[[joint]]", "# FILL IN: of the joint\n[[joint]] # FILL IN", []),
        ('name = "joint_1"', 'name = "joint_1" # FILL IN', []),
        (
            'name = "made up"',
            '# Made by a program. FILL IN marks what is not known.\nname = "x"',
            [],
        ),
    ],
)
def test_marks_of_ratios_and_limits_count(line, marks, counts):
    """`counts`: which of the lines put in the place of `line`."""
    text = bus_text(1)
    first = text[: text.index(line)].count("\n")
    found = lines_to_fill_in(robot_of(text.replace(line, marks, 1)))
    assert found == [first + k for k in counts]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["socketcan", "--bitrate", "500000"],
            "sets the bit rate of socketcan. Run this instead: `ip link set can0",
        ),
        (["slcan"], "--bitrate is missing: a wrong bit rate destroys the frames of other nodes"),
        (["slcan", "--bitrate", "123"], "--bitrate = 123"),
        (["virtual", "--toml", "here.toml"], "here.toml: the file already exists"),
    ],
)
def test_refused_options(options, said, tmp_path, monkeypatch, capsys):
    (tmp_path / "here.toml").write_text("mine")
    monkeypatch.chdir(tmp_path)
    assert main(["scan", "--channel", "can0", "--interface", *options]) == 1
    assert said in capsys.readouterr().err
    assert (tmp_path / "here.toml").read_text() == "mine"


def test_empty_bus(tmp_path, capsys):
    assert scan("scan_nobody", "--toml", str(tmp_path / "bus.toml")) == 1
    assert "bus: virtual scan_nobody: no node answers" in capsys.readouterr().err
    assert not (tmp_path / "bus.toml").exists()


@pytest.mark.parametrize(
    ("values", "lines"),
    [
        ({}, ['reference = "6074"', "rated_torque_nm = 0.42", "counts_per_turn = 65536"]),
        ({(0x6091, 1): 9, (0x6092, 1): 2304}, ['reference = "6074"', "rated_torque_nm = 0.42",
                                               "counts_per_turn = 256"]),
        ({(0x6091, 2): 0, (0x6092, 2): 4}, ['reference = "6074"', "rated_torque_nm = 0.42",
                                            "counts_per_turn = 16384"]),
        ({(0x6092, 1): 0, (0x608F, 2): 0, (0x6076, 0): 0}, ['reference = "6074"']),
        ({(0x6076, 0): 0xFFFFFFFF}, ['reference = "6074"', "counts_per_turn = 65536"]),
        ({(0x6074, 0): None, (0x6075, 0): 1250}, ['actual = "6077"', "rated_torque_nm = 0.42",
                                                  "counts_per_turn = 65536"]),
        ({(0x6074, 0): None, (0x6077, 0): None, (0x6075, 0): 1250},
         ['actual = "6078"', "rated_current_a = 1.25"]),
        ({(0x6074, 0): None, (0x30D0, 0): 7},
         ['objects = { "30D0" = "I32" }', 'reference = "30D0"', "counts_per_turn = 65536"]),
    ],
)  # fmt: skip
def test_drive_units_and_efforts(values, lines):
    link = drives_of(1)
    (node,) = link.drives.nodes
    for key, value in values.items():
        node.types.setdefault(key, "I32")
        node.values[key] = 0 if value is None else value
        if value is None:
            del node.values[key]
    nodes = scan_nodes(Uploads(link, bus_file()), OBJECTS, ARRAYS)
    written = list(bus_lines(bus_file(), nodes))
    at = next(k for k, line in enumerate(written) if line.startswith("node = 1"))
    stated = [line.split(" #")[0] for line in written[at + 1 :] if not line.startswith("#")]
    assert stated[: len(lines)] == lines
    assert len(stated) == len(lines) + (lines[0] == 'actual = "6078"')
    (effort,) = (line for line in written if line.startswith(("reference = ", "actual = ")))
    assert ("FILL IN" in effort) == ("30D0" in effort)
    assert effort.endswith({'"6078"': ", A", '"30D0"': ", A"}.get(effort.split()[2], ", N m"))
