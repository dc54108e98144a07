"""Logs of other tools in, CSV out."""

import can
import numpy as np
import pytest
from made_up_buses import bus_text, flat, robot_of, session
from made_up_recordings import header

from acquisition.bus import read_log
from acquisition.commands import main
from acquisition.errors import BadInputError
from acquisition.files import read_columns
from acquisition.importing import export_csv, import_log, import_recording
from acquisition.recording import ERROR, SENT, RecordingWriter, read_recording
from acquisition.session import Recorder
from identification import load_signals

ROBOT = robot_of(bus_text())


def write_log(path, frames) -> None:
    with can.Logger(path) as logger:
        for row in frames:
            logger.on_message_received(
                can.Message(
                    timestamp=row["time_ns"] * 1e-9,
                    arbitration_id=int(row["can_id"]),
                    is_extended_id=False,
                    data=row["data"].tobytes()[: row["length"]],
                    channel=0 if path.suffix != ".log" else "can0",
                )
            )


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".trc"])
def test_logs_of_other_tools_are_decoded(tmp_path, suffix):
    log, out = tmp_path / f"a{suffix}", tmp_path / "a.mcap"
    frames = flat(session(targets=True))
    write_log(log, frames)
    found = import_log(log, out, ROBOT, "robot.toml")
    recording = read_recording(out)
    assert (len(recording.samples), found.warnings) == (50, ())
    assert "reference" in recording.samples.dtype.names
    stored = recording.frames["log"]
    for field in ("can_id", "length", "data"):
        assert stored[field].tolist() == frames[field].tolist()
    assert recording.samples["position"][0, 0] * 50 * 65536 / (2 * np.pi) == pytest.approx(1000)
    assert recording.metadata["source"] == f"log a{suffix}"


TRC = """;$FILEVERSION=1.1
;$STARTTIME=43474.5
;   Start time: 09.01.2019 12:00:00.000.0
;   Message Number) Time Offset (ms) Type ID (hex) Data Length Data Bytes (hex)
     1)         0.0  Rx         0080  0
     2)         1.5  Rx         0181  8  37 12 E8 03 00 00 F4 FF
     3)         2.0  Warng  FFFFFFFF  4  00 00 00 08  BUSHEAVY
     4)         4.0  Tx         0601  2  40 41
"""


def test_pcan_trace_by_hand(tmp_path):
    """Days since 1899-12-30 and milliseconds: noon of 2019-01-09, 1547035200 s of Unix time.

    The status line is no frame.
    """
    (tmp_path / "a.trc").write_text(TRC)
    base = 1_547_035_200_000_000_000
    frames, _ = read_log(tmp_path / "a.trc")
    assert [
        (f["time_ns"] - base, f["can_id"], f["data"][: f["length"]].tobytes().hex(), f["flags"])
        for f in frames.pop("1")
    ] == [
        (0, 0x80, "", 0),
        (pytest.approx(1_500_000, abs=500), 0x181, "3712e8030000f4ff", 0),
        (pytest.approx(4_000_000, abs=500), 0x601, "4041", SENT),
    ]
    assert not frames


def test_trace_import_needs_no_map(tmp_path, capsys):
    (tmp_path / "r.toml").write_text(bus_text())
    command = ["--robot", tmp_path / "r.toml", "-o", tmp_path / "a.mcap", "--overwrite"]
    write_log(tmp_path / "a.trc", flat(session()))
    assert "a.mcap: made up, 50 samples at 500 Hz" in told(
        capsys, "import", tmp_path / "a.trc", *command
    )
    (tmp_path / "a.trc").write_text(TRC)
    for tables, words in (
        (["a.trc"], "a.trc: only 1 of 3 frames are SYNC (0x80)"),
        (["a.trc", "b.csv"], "b.csv: a table needs a map of its columns. Pass --map MAP.toml"),
        (["a.trc"] * 2, "a.trc: only one CAN log can be"),
    ):
        assert words in told(capsys, "import", *(tmp_path / name for name in tables), *command)


def test_csv_has_every_digit(tmp_path):
    log, mcap, out = tmp_path / "a.log", tmp_path / "a.mcap", tmp_path / "a.csv"
    write_log(log, flat(session(targets=True)))
    import_log(log, mcap, ROBOT, "robot.toml")
    assert export_csv(mcap, out) == 50
    names = ["time_s", "joint_2_position_rad", "joint_1_effort_N_m", "joint_1_reference_rad"]
    table, samples = read_columns(out, names, len(names)), read_recording(mcap).samples
    assert table[:, 0] == pytest.approx(np.arange(50) * 0.002)
    true = [samples["position"][:, 1], samples["effort"][:, 0], samples["reference"][:, 0]]
    assert table[:, 1:].tolist() == np.stack(true, axis=1).tolist()


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.log", b"", "contains no frames"),
        (
            "a.log",
            b"(1.0) can0 080#\n(1.0) can0 zzz\n",
            "line 2: the line is not a frame of candump",
        ),
        ("a.log", b"(1.0) can0 080#0\n", "line 1: the line is not a frame of candump"),
        ("a.log", b"(-5.0) can0 080#\n", "line 1: the line is not a frame of candump"),
        ("a.log", b"(1.0) can0 40000080#\n", "frame 1: .*identifier 0x40000080 .*29 bits"),
        ("a.asc", b"\xff\xfe\n", "contains no frames|damaged"),
        ("a.txt", b"x", "suffix '.txt' is unknown: expected .log"),
        ("a.trc", b"1)  1059.9  Rx  0181  8  00 00\n", "damaged"),
        (
            "a.trc",
            b";$FILEVERSION=1.1\n1)  1059.9  Rx  0181  8  00 00\n",
            r"damaged after 0 frames: TRCReader: .* message '1\)",
        ),
        (
            "a.trc",
            b";$FILEVERSION=1.2\n1)  1059.9 1  Rx  0080  0\n",
            "version 1.2 of the PCAN format is not supported: expected",
        ),
        (
            "a.log",
            b"(1.0) can0 080#\n(1.1) can0 181#001122334455667788\n",
            "frame 2: .*0x181 and 9 bytes: expected .*at most 29 bits and 8 bytes",
        ),
        (
            "a.log",
            b"(1.2) can0 181##1000102030405060708090A0B\n",
            r"contains no frames of classic CAN \(1 of CAN FD\)",
        ),
    ],
)
def test_invalid_logs(tmp_path, name, content, expected):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(BadInputError, match=expected):
        import_log(tmp_path / name, tmp_path / "o.mcap", ROBOT, "robot.toml")
    assert not (tmp_path / "o.mcap").exists()


@pytest.mark.parametrize("time", ["2147483648.0", "2147483649.0", "9999999999.5"])
@pytest.mark.parametrize("name", ["a.log", "a.asc"])
def test_time_out_of_recording_range(tmp_path, name, time):
    log = tmp_path / name
    line = "({}) can0 080#\n" if name == "a.log" else " {} 1  80  Rx d 0\n"
    head = "" if name == "a.log" else "base hex timestamps absolute\nno internal events logged\n"
    log.write_text(head + "".join(line.format(t) for t in ("1.0", "1.001", time)))
    with pytest.raises(BadInputError) as caught:
        import_log(log, tmp_path / "o.mcap", ROBOT, "robot.toml")
    told = f"the frame has time {float(time):.10g} s, identifier 0x80 and 0 bytes"
    assert str(caught.value).startswith(f"{log}: frame 3: {told}: expected 0 to 2147483648 s")
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize(
    ("channel", "more", "left_out", "count"),
    [
        (
            "test",
            "(1.2) can0 181##1000102030405060708090A0B\n",
            ("left out: 1 of CAN FD",),
            150,
        ),
        ("test", "(1.2) can1 181##100\n" * 2, ("left out: 2 of CAN FD",), 150),
        ("can1", None, ("only the frames of can1 are imported; left out: 150 of can0",), 150),
        ("test", "(1.098500) can0 20000080#0000000000000000\n", (), 151),
    ],
)
def test_skipped_log_frames(tmp_path, channel, more, left_out, count):
    log, out = tmp_path / "a.log", tmp_path / "o.mcap"
    write_log(log, flat(session()))
    log.write_text(
        log.read_text() + (log.read_text().replace("can0", "can1") if more is None else more)
    )
    found = import_log(log, out, robot_of(bus_text(channel=channel)), "robot.toml")
    assert (len(read_recording(found.out).samples), found.warnings) == (50, left_out)
    recording = read_recording(out)
    frames = recording.frames["log"]
    assert (len(frames), bool(frames["flags"][-1] & ERROR)) == (count, count == 151)
    assert recording.metadata.get("left_out", "") == "".join(left_out)


def test_two_interfaces_are_kept_apart(tmp_path):
    log = tmp_path / "a.log"
    write_log(log, flat(session()))
    log.write_text(log.read_text() + log.read_text().replace("can0", "can1"))
    with pytest.raises(
        BadInputError, match=r"150 of can0, 150 of can1. Set bus.channel .* 'can0', 'can1'"
    ) as caught:
        import_log(log, tmp_path / "o.mcap", ROBOT, "robot.toml")
    assert caught.value.place == str(log)


def test_missing_frames_or_samples_are_reported(tmp_path):
    with RecordingWriter(tmp_path / "a.mcap", header(ROBOT, 500.0)):
        pass
    with pytest.raises(BadInputError, match="contains no frames"):
        import_recording(tmp_path / "a.mcap", tmp_path / "o.mcap", None, "x")
    with pytest.raises(BadInputError, match="contains no samples"):
        export_csv(tmp_path / "a.mcap", tmp_path / "o.csv")


def recorder_of(path, frames) -> Recorder:
    recorder = Recorder(path, ROBOT, source="x", place="robot.toml")
    recorder.add(frames)
    return recorder


def told(capsys, *arguments) -> str:
    status = main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    return f"{status} {captured.out}{captured.err}"


def test_all_commands_say_why_no_samples(tmp_path, capsys):
    log, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    frames = flat(session(syncs=400, targets=True))
    recorder = recorder_of(
        log, np.delete(frames, np.flatnonzero(frames["can_id"] == 0x181)[10:-10:8])
    )
    why = "12.0% of the PDOs of a drive are missing, more than 5%"
    assert why in recorder.finish(3 * 10**9).no_samples
    assert read_recording(log).samples is None
    for command in (["info", log], ["info", log, "--csv", tmp_path / "a.csv"]):
        assert why in told(capsys, *command)
    with pytest.raises(BadInputError, match=why):
        load_signals(log)
    cut.write_bytes(log.read_bytes()[:-100])
    assert f"warning: no samples: {cut}: {why}" in told(
        capsys, "import", cut, "-o", tmp_path / "b.mcap"
    )


def test_truncated_recording_keeps_samples(tmp_path, capsys):
    recorder = recorder_of(tmp_path / "a.mcap", flat(session()))
    recorder.tick(1, 0, now=True)
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "a.mcap").read_bytes())
    recorder.finish(3 * 10**9)
    out = tmp_path / "out.mcap"
    assert "made up, 50 samples at 500 Hz" in told(
        capsys, "import", tmp_path / "cut.mcap", "-o", out
    )
    assert (
        read_recording(out).samples.tobytes()
        == read_recording(tmp_path / "a.mcap").samples.tobytes()
    )


def test_own_late_sync_is_reported(tmp_path, capsys):
    frames = flat(session())
    late = frames.copy()
    late["time_ns"][75:] += 4_000_000
    lost = np.delete(frames, [75, 76, 77])
    lost["flags"] = 0
    for name, block, words in (
        ("a", late, "1, 0 samples missing, 1 SYNC late"),
        ("b", lost, "1, 2 samples missing, 0 SYNC"),
    ):
        recorder_of(tmp_path / f"{name}.mcap", block).finish(3 * 10**9)
        assert words in told(capsys, "info", tmp_path / f"{name}.mcap")
    exported = told(capsys, "info", tmp_path / "b.mcap", "--csv", tmp_path / "b.csv")
    assert "warning: 2 samples are missing in 1 gaps" in exported


def test_block_size_changes_nothing(tmp_path, monkeypatch, capsys):
    with RecordingWriter(tmp_path / "a.mcap", header(ROBOT, 500.0)) as writer:
        writer.frames("can0", flat(session(targets=True)))
    made = []
    for name in ("b", "c"):
        recording, table = tmp_path / f"{name}.mcap", tmp_path / f"{name}.csv"
        import_recording(tmp_path / "a.mcap", recording, None, "x")
        export_csv(recording, table)
        overview = told(capsys, "info", tmp_path / "b.mcap")
        made.append((read_recording(recording).samples.tobytes(), table.read_bytes(), overview))
        for constant in ("rows._AT_ONCE", "rows._TAKEN", "decoding._AT_ONCE"):
            monkeypatch.setattr(f"acquisition.recording.{constant}", 7)
    assert made[0] == made[1]
