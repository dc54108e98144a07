"""CAN logs as other tools write them: order and gaps of their times, numbers of channels, forms of
lines, ends that are cut. Every row has to be that of the SYNC at its time.
"""

import can
import numpy as np
import pytest
from made_up_buses import bus_text, counts, flat, robot_of, session

from acquisition.bus import read_log
from acquisition.errors import BadInputError
from acquisition.importing import import_log
from acquisition.recording import SENT, read_recording

PERIOD_NS = 2_000_000
SYNC = 0x80


def made_up(syncs=300, at_s=1000.0, **options):
    """Frames of a session of which SYNC 0 came at this time."""
    frames = flat(session(syncs=syncs, **options))
    frames["time_ns"] += round(at_s * 1e9) - frames["time_ns"][0]
    return frames


def candump(frames, channel="can0") -> str:
    return "".join(
        f"({f['time_ns'] // 10**9}.{f['time_ns'] % 10**9:09d}) {channel} {f['can_id']:03X}#"
        f"{f['data'][: f['length']].tobytes().hex()}\n"
        for f in frames
    )


def asc(frames, channel=1, relative=False, date="Sat Nov 21 10:00:00.000 am 2026") -> str:
    time_s = frames["time_ns"] / 1e9
    time_s = np.diff(time_s, prepend=0.0) if relative else time_s
    lines = [f"date {date}", f"base hex  timestamps {'relative' if relative else 'absolute'}"]
    lines += ["no internal events logged", f"Begin Triggerblock {date}"]
    for f, t in zip(frames, time_s, strict=True):
        way = "Tx" if f["flags"] & SENT else "Rx"
        data = f["data"][: f["length"]].tobytes().hex(" ")
        lines.append(f" {t:.6f} {channel}  {f['can_id']:X}  {way}   d {f['length']} {data}")
    return "\n".join([*lines, "End TriggerBlock", ""])


def trc(frames, bus=1) -> str:
    rows = enumerate(frames, 1)
    return ";$FILEVERSION=1.3\n;$STARTTIME=45248.5\n; Prüfstand\n" + "".join(
        f"{k:6d}) {f['time_ns'] / 1e6:13.3f} {bus}  {'Tx' if f['flags'] & SENT else 'Rx'}  "
        f"{f['can_id']:04X} -  {f['length']}  {f['data'][: f['length']].tobytes().hex(' ')}\n"
        for k, f in rows
    )


def imported(path, content="", robot=None):
    """Recording and summary of a log with this content."""
    if content:
        path.write_bytes(content if isinstance(content, bytes) else content.encode("cp1252"))
    out = path.with_suffix(".mcap")
    found = import_log(path, out, robot or robot_of(bus_text(channel="can0")), "robot.toml")
    return read_recording(out), found


def true_rows(recording, lost=0, shift=0):
    """Number of rows; each is of the SYNC at its time since the first, which is SYNC `lost`."""
    samples, scale = recording.samples, 50 * 65536 / (2 * np.pi)
    k = np.rint((samples["stamp_ns"] - samples["stamp_ns"][0]) / PERIOD_NS).astype(int) + lost
    for node in (1, 2):
        expected = [counts(node, one + shift) for one in k]
        assert np.rint(samples["position"][:, node - 1] * scale).astype(int).tolist() == expected
    return len(samples)


def behind_its_answer(frames, which):
    """Lines in another order: SYNC stands behind the first answer, of two SYNCs the second with its
    answers comes first, or all frames of a queue do.
    """
    order = np.arange(len(frames))
    if which == "queues":
        sent = frames["can_id"] == SYNC
        order = np.lexsort((order, ~sent, frames["time_ns"] // 100_000_000))
    elif which == "syncs":
        order = order.reshape(-1, 6)[:, [3, 4, 5, 0, 1, 2]]
    else:
        order = order.reshape(-1, 3)[:, [1, 0, 2] if which == "all" else [0, 1, 2]].copy()
        if which == "some":
            order[::30] = order[::30, [1, 2, 0]]
    return frames[order.ravel()]


@pytest.mark.parametrize("which", ["all", "some", "syncs", "queues"])
def test_frames_are_sorted_by_time(tmp_path, which):
    frames = behind_its_answer(made_up(), which)
    recording, found = imported(tmp_path / "a.log", candump(frames))
    assert true_rows(recording) == 300
    back = np.count_nonzero(np.diff(frames["time_ns"]) < 0)
    assert back > 2
    assert found.warnings == (
        f"{back} frames were out of order: all frames are sorted by their times",
    )
    stored = recording.frames["log"]
    assert (np.diff(stored["time_ns"]) > 0).all()
    assert stored.tobytes() == np.sort(stored, order="time_ns").tobytes()


@pytest.mark.parametrize("wrap_s", [60.0, 4294.967296, 86400.0])
@pytest.mark.parametrize("which", ["none", "all", "syncs"])
def test_wrapping_time_counter_continues(tmp_path, wrap_s, which):
    """SYNC 100 comes before it wraps, its answers after."""
    frames = behind_its_answer(made_up(at_s=wrap_s - 0.2001), which)
    frames["time_ns"] %= round(wrap_s * 1e9)
    recording, found = imported(tmp_path / "a.log", candump(frames))
    assert true_rows(recording) == 300
    assert found.warnings[0].startswith("the time counter wrapped after ")
    assert int(recording.samples["stamp_ns"][-1]) == round((wrap_s - 0.2001 + 0.598) * 1e9)


def test_minute_step_beyond_range_is_no_wrap(tmp_path):
    frames = made_up(at_s=100.0)
    frames["time_ns"][450:] -= 60 * 10**9
    with pytest.raises(BadInputError, match="back by 60 s"):
        imported(tmp_path / "a.log", candump(frames))


@pytest.mark.parametrize(
    ("back_ms", "which"),
    [(500, "none"), (500, "all"), (240, "syncs"), (5, "none"), (5, "all")],
)
def test_clock_set_back(tmp_path, back_ms, which):
    """By the truth that SYNC 700 came 2 ms after SYNC 699."""
    frames = behind_its_answer(made_up(syncs=1000), which)
    frames["time_ns"][2100:] -= back_ms * 1_000_000
    recording, found = imported(tmp_path / "a.log", candump(frames))
    assert true_rows(recording) == 1000
    assert found.warnings[0].startswith(f"the clock was set back by {back_ms / 1e3:.3g} s at 1.39")


@pytest.mark.parametrize("begins_s", [1000.0, 999.0, 1000.1])
def test_two_sessions_in_file(tmp_path, begins_s):
    log = tmp_path / "a.log"
    with pytest.raises(BadInputError, match=r"step back by .* at 0.598 s, at frame 901. .*two"):
        imported(log, candump(made_up()) + candump(made_up(at_s=begins_s)))
    assert list(tmp_path.iterdir()) == [log]


def test_clock_set_back_over_a_minute(tmp_path):
    """Late in a long session: rather another one."""
    frames = made_up(at_s=1000.0)
    frames["time_ns"][300:] += 500 * 10**9
    frames["time_ns"][600:] -= 61 * 10**9
    with pytest.raises(BadInputError, match="back by 61 s at 500"):
        imported(tmp_path / "a.log", candump(frames))


def test_other_frames_do_not_shift_clock(tmp_path):
    """A heartbeat whose line is 100 ms late, and one whose stamp is wrong by a day."""
    frames = made_up()
    beats = frames[[300, 600]].copy()
    beats["can_id"], beats["length"] = 0x701, 1
    beats["time_ns"] += np.array([-100_000_000, 86_400 * 10**9])
    frames = np.insert(frames, [450, 601], beats)
    assert true_rows(imported(tmp_path / "a.log", candump(frames))[0]) == 300


def test_rows_dropped_at_ends_are_reported(tmp_path):
    frames = made_up()
    for first, end in ((0, 30), (280, 300)):
        some = frames[~((frames["can_id"] == 0x182) & (np.arange(900) // 3 >= first) &
                        (np.arange(900) // 3 < end))]  # fmt: skip
        recording, found = imported(tmp_path / f"{first}.log", candump(some))
        assert true_rows(recording, lost=end if first == 0 else 0) <= 300 - (end - first)
        told = f"{300 - len(recording.samples)} of 300 SYNC at the beginning and the end"
        assert any(told in text for text in found.warnings)
    _, found = imported(tmp_path / "all.log", candump(frames[:-5]))
    assert found.warnings == ()


@pytest.mark.parametrize(("factor", "uneven", "text"), [
    (1.5, 0.0, "SYNC came every 3 ms, .*Set it to 0.003 and import"),
    (0.6, 0.2, "SYNC came 0.8 to 1.6 ms after the previous one.*Check whether each is recorded"),
])  # fmt: skip
def test_only_even_period_blames_robot_toml(tmp_path, factor, uneven, text):
    """Every other SYNC and its answers are late by `uneven` periods."""
    frames, groups = made_up(), np.arange(900) // 3
    frames["time_ns"] += np.rint(
        PERIOD_NS * ((factor - 1) * groups + uneven * (groups % 2))
    ).astype(np.int64)
    with pytest.raises(BadInputError, match=text) as caught:
        imported(tmp_path / "a.log", candump(np.sort(frames, order="time_ns")))
    assert ("Set it to" in str(caught.value)) == (not uneven)


def test_duplicate_syncs_count_once(tmp_path):
    frames = made_up()
    echo = frames[frames["can_id"] == SYNC].copy()
    echo["time_ns"] += 100_000
    both = np.sort(np.concatenate([frames, echo]), order="time_ns")
    assert true_rows(imported(tmp_path / "a.log", candump(both))[0]) == 300


def blf(path, both) -> None:
    with can.BLFWriter(path) as writer:
        for frame, channel in both:
            writer.on_message_received(
                can.Message(
                    timestamp=frame["time_ns"] / 1e9,
                    arbitration_id=int(frame["can_id"]),
                    is_extended_id=False,
                    data=frame["data"].tobytes()[: frame["length"]],
                    channel=channel - 1,  # python-can's; in the file from 1
                )
            )


def one_by_one(a, b, head):
    """Lines of two logs in turn, so that times grow, below the head of the first."""
    a, b = a.splitlines(keepends=True), b.splitlines(keepends=True)
    pairs = zip(a[head:], b[head:], strict=True)
    return "".join([*a[:head], *(line for pair in pairs for line in pair)])


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".trc"])
def test_channels_have_file_numbers(tmp_path, suffix):
    """The drives at CAN 2 are 100 SYNCs ahead."""
    path = tmp_path / f"a{suffix}"
    one, two = made_up(), made_up(syncs=400)[300:]
    two["time_ns"] = one["time_ns"] + 50_000
    if suffix == ".blf":
        blf(path, [(f, k) for pair in zip(one, two, strict=True) for k, f in enumerate(pair, 1)])
    else:
        texts = (asc(one), asc(two, 2)) if suffix == ".asc" else (trc(one), trc(two, 2))
        path.write_text(one_by_one(*texts, 4 if suffix == ".asc" else 3), encoding="utf-8")
    for number, shift in ((1, 0), (2, 100)):
        recording, found = imported(path, robot=robot_of(bus_text(channel=str(number))))
        assert true_rows(recording, shift=shift) == 300
        told = f"only the frames of CAN {number} are imported; left out: 900 of CAN {3 - number}"
        assert found.warnings == (told,)
    with pytest.raises(BadInputError, match=r"900 of CAN 1, 900 of CAN 2.* of '1', '2'"):
        imported(path, robot=robot_of(bus_text(channel="0")))
    one = read_log(path)[0]["1"]
    assert (one["can_id"] == made_up()["can_id"]).all()


def test_relative_times_add_up(tmp_path):
    frames = made_up(at_s=0.5)
    text = asc(frames, relative=True)
    assert true_rows(imported(tmp_path / "a.asc", text)[0]) == 300
    lines = text.splitlines(keepends=True)
    event = " 0.000100 1  Statistic: D 0 R 0 XD 0 XR 0 E 0 O 0 B 0.0%\n"
    for k in range(300, 4, -60):  # an event of its own stands between two frames
        stamp, rest = lines[k].split(maxsplit=1)
        lines[k] = event + f" {float(stamp) - 1e-4:.6f} {rest}"
    again, _ = imported(tmp_path / "b.asc", "".join(lines))
    first = read_recording(tmp_path / "a.mcap")
    assert np.abs(again.samples["stamp_ns"] - first.samples["stamp_ns"]).max() < 1000
    assert len(again.samples) == 300


@pytest.mark.parametrize(("word", "off_ns", "told"), [
    ("TxRq", -100_000, "left out: 300 requests to send (TxRq)"),
    ("Rx", 40_000, "300 frames are recorded as sent and again as received: they count once"),
    ("Rx", -90_000, "300 frames are recorded as sent and again as received: they count once"),
])  # fmt: skip
def test_requested_or_echoed_frame_counts_once(tmp_path, word, off_ns, told):
    frames = made_up()
    sent = frames[frames["can_id"] == SYNC].copy()
    sent["time_ns"] += off_ns
    lines = sorted(
        (frame["time_ns"], line)
        for some, way in ((frames, "Tx"), (sent, word))
        for frame, line in zip(some, asc(some).replace("Tx", way).splitlines()[4:-1], strict=True)
    )
    text = "\n".join([*asc(frames).splitlines()[:4], *(line for _, line in lines), ""])
    recording, found = imported(tmp_path / "a.asc", text)
    assert true_rows(recording) == 300
    assert found.warnings == (told,)
    assert np.count_nonzero(recording.frames["log"]["can_id"] == SYNC) == 300


def test_frames_similar_to_sent_are_kept(tmp_path):
    """Other bytes, another length, half a period away and received twice, and one sent twice."""
    frames = made_up(syncs=50)
    sent, other = frames[0].copy(), frames[[0, 0, 0, 0]]
    sent["can_id"] = other["can_id"] = 0x203
    sent["length"] = other["length"] = (2, 2, 1, 2)[0]
    other["length"] = (2, 1, 2, 2)
    other["data"][0, 0] = 1
    other["flags"], sent["time_ns"] = 0, sent["time_ns"] + 100_000
    other["time_ns"] = sent["time_ns"] + np.array([10_000, 20_000, 1_000_000, 1_010_000])
    twice = sent.copy()
    twice["time_ns"] += 30_000
    more = np.sort(np.concatenate([frames, other, [sent, twice]]), order="time_ns")
    text = "".join(
        line.rstrip() + (" T\n" if f["flags"] & SENT else " R\n")
        for f, line in zip(more, candump(more).splitlines(), strict=True)
    )
    recording, found = imported(tmp_path / "a.log", text)
    assert (len(recording.frames["log"]), found.warnings) == (156, ())


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.asc", asc(made_up(), date="Sam Mär 14 10:00:00.000 2026")),
        ("a.trc", trc(made_up())),
        ("a.asc", asc(made_up()).replace("no int", "// Roboter 3, Böhm\nno int")),
    ],
)
@pytest.mark.parametrize("encoding", ["cp1252", "utf-8"])
def test_headers_in_any_encoding(tmp_path, name, text, encoding):
    assert true_rows(imported(tmp_path / name, text.encode(encoding))[0]) == 300


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("a.log", "  can0  181   [8]  27 06 00 00 00 00 00 00\n", "line 1: .*screen.*candump -l"),
        ("a.log", " (1.5)  can0  181   [2]  27 06\n", "line 1: .*screen.*candump -l"),
        ("a.log", "  can0  181   {2}  27 06\n", "line 1: .*screen.*candump -l"),
        ("a.log", "***BUSMASTER Ver 3.2.2***\n***HEX***\n", "BUSMASTER.*Export it as .asc"),
        ("a.log", ";$FILEVERSION=1.1\n", "of PCAN, not of candump. Rename it to .trc"),
        ("a.log", "   1)  1059.9  Rx  0181  0\n", "of PCAN, not of candump. Rename it to .trc"),
        ("a.log", "date Sat Nov 21\nbase hex\n", "of Vector, not of candump. Rename it to .asc"),
        (
            "a.log",
            "(1.0) can0 080#\n(1.1) can0 0(1.2) can0 080#\n",
            "line 2: the line is not a frame",
        ),
        ("a.log", "x" * 3000 + "\n", "line 1: the line is not a frame"),
        ("a.log", "x" * 3000, r"no frames of classic CAN \(1 truncated last line\)"),
        ("a.log", b"(1.0) can\xff 080#\nx\n", "line 2: the line is not a frame"),
        ("a.log", "(1.0) can0 080#\n" * 200 + "x\n", "line 201: the line is not a frame"),
        (
            "a.log",
            "(1.0) can0 080#\n" * 200 + "(1.0) can0 FFFFFFFF#\n",
            "frame 201: .*0xFFFFFFFF .*29 bits",
        ),
        (
            "a.log",
            "".join(f"(1.0) c{k} 080#\n" for k in range(65)),
            "1 of c29 and 35 more. Set bus.channel .* to one of .* and 35 more",
        ),
        (
            "a.asc",
            "base hex\nno\n 1.0 1 20000000x Rx d 0\n",
            "frame 1: .*identifier 0x20000000 .*29 bits",
        ),
        (
            "a.asc",
            "base hex\nno\n 1.0 1 FFFFFFFFFFx Rx d 0\n",
            "identifier 0xFFFFFFFFFF .*29 bits",
        ),
        ("a.trc", ";$FILEVERSION=1.1\n 1) 1.0 Rx 3FFFFFFF 0\n", "identifier 0x3FFFFFFF .*29 bits"),
        ("a.log", "(1.0) can0 FFFFFFFF#\n", "frame 1: .*identifier 0xFFFFFFFF .*29 bits"),
    ],
)
def test_unreadable_logs_are_named(tmp_path, name, content, expected):
    with pytest.raises(BadInputError, match=expected) as caught:
        imported(tmp_path / name, content)
    assert caught.value.place.startswith(str(tmp_path / name))


def test_identifier_over_11_bits_is_extended(tmp_path):
    """Not marked by its x: 0x10080 is not the SYNC."""
    frames = made_up()
    other = frames[frames["can_id"] == SYNC].copy()
    other["can_id"], other["time_ns"] = 0x10080, other["time_ns"] + 100_000
    text = asc(np.sort(np.concatenate([frames, other]), order="time_ns"))
    assert true_rows(imported(tmp_path / "a.asc", text)[0]) == 300


@pytest.mark.parametrize("end", [1, 2, 3, 27, 42])
@pytest.mark.parametrize("more", [b"", b"\0" * 4096])
def test_truncated_candump(tmp_path, end, more):
    """The last frame is the answer of drive 2 to SYNC 299."""
    content = candump(made_up()).encode()[:-end] + more
    recording, found = imported(tmp_path / "a.log", content)
    assert true_rows(recording) == 299
    assert found.warnings == ("left out: 1 truncated last line",)
    assert len(recording.frames["log"]) == 899


@pytest.mark.parametrize("name", ["a.asc", "a.trc"])
@pytest.mark.parametrize("end", [1, 2, 9])
def test_other_truncated_texts(tmp_path, name, end):
    text = asc(made_up()).removesuffix("End TriggerBlock\n") if name == "a.asc" else trc(made_up())
    recording, found = imported(tmp_path / name, text[:-end])
    assert (true_rows(recording), len(recording.frames["log"])) == (299, 899)
    assert found.warnings == ("left out: 1 truncated last line",)
    _, found = imported(tmp_path / "b.asc", asc(made_up())[:-1])  # its last line is no frame
    assert found.warnings == ()


@pytest.mark.parametrize("which", ["none", "all"])
def test_large_logs_use_temporary_files(tmp_path, monkeypatch, which):
    text = candump(behind_its_answer(made_up(targets=False), which))
    whole, _ = imported(tmp_path / "a.log", text)
    monkeypatch.setattr("acquisition.files.on_disk.MAX_BYTES_IN_MEMORY", 100)
    monkeypatch.setattr("acquisition.files.on_disk.BLOCK_ROWS", 7)
    parts, _ = imported(tmp_path / "b.log", text)
    assert parts.samples.tobytes() == whole.samples.tobytes()
    assert parts.frames["log"].tobytes() == whole.frames["log"].tobytes()
