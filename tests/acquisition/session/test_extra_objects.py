"""Extra objects: their PDOs, and their raw integers in the recorded frames; older
recordings; SYNC periods refused.
"""

import numpy as np
import pytest
from dry_sessions import dry_session, swing
from made_up_buses import bus_of, bus_text, robot_of

from acquisition.errors import BadInputError
from acquisition.importing import import_recording
from acquisition.recording import (
    Header,
    RecordingWriter,
    Traffic,
    read_recording,
    sample_dtype,
    writer,
)
from acquisition.robot import load_robot
from acquisition.session import Task

EXTRA = (
    'extra = ["606C", "6077", "2081:1", "2082"]\nobjects = { "2081:1" = "I16", "2082" = "U8" }\n'
)


def test_simulated_drives_send_velocity(tmp_path):
    robot = robot_of(bus_text(2, drive='extra = ["606C"]'))
    dry_session(
        tmp_path / "a.mcap", Task(reference=swing(2, seconds=0.6, amplitude=0.05)), robot=robot
    )
    recording = read_recording(tmp_path / "a.mcap")
    (frames,) = recording.frames.values()
    traffic, samples = Traffic(frames), recording.samples
    assert samples.dtype == sample_dtype(2, reference=True)
    for i, drive in enumerate(bus_of(robot).drives):
        (entry,) = drive.extras
        pdo = drive.carrier(entry, "tpdo")
        rows = traffic.rows_of(pdo.can_id)
        counts_s = traffic.integers(rows, pdo, entry)
        at = np.searchsorted(frames["time_ns"][rows], samples["stamp_ns"]).clip(max=len(rows) - 1)
        motor = robot.motor_position(samples["position"])[:, i]
        expected = (
            np.gradient(motor, 0.002)
            * drive.position_codec.sign
            * drive.position_codec.counts_per_unit
        )
        assert np.ptp(expected) > 1e4
        assert np.abs(counts_s[at] - expected)[5:-5].max() < 0.03 * np.ptp(expected)


TABLE = '{ object = "2081:1", name = "temperature", scale = 0.1, unit = "degC" }'


def test_earlier_recordings_still_open(tmp_path, monkeypatch):
    text = bus_text(2, drive=EXTRA.replace('"2081:1",', f"{TABLE},"))
    (drive, _), robot = bus_of(robot_of(text)).drives, robot_of(text)
    assert [[str(e) for e in pdo.entries] for pdo in drive.tpdos[1:]] == [
        ["606C:0", "6077:0", "2081:1"],
        ["2082:0"],
    ]
    old = np.dtype([*sample_dtype(2, reference=True).descr, ("extra", "<f8", (8,))])
    rows = np.zeros(300, old)
    rows["stamp_ns"] = 10**18 + 2_000_000 * np.arange(300)
    for name in ("position", "reference", "effort", "extra"):
        rows[name] = np.random.default_rng(1).normal(size=rows[name].shape)
    header = Header(robot=robot, source="x", sample_rate_hz=500.0, effort_provenance="")
    with monkeypatch.context() as patched, RecordingWriter(tmp_path / "old.mcap", header) as out:
        patched.setattr(writer, "sample_layouts", lambda robot: [old])
        out.samples(rows)
    (tmp_path / "cut.mcap").write_bytes((tmp_path / "old.mcap").read_bytes()[:-40])
    import_recording(tmp_path / "cut.mcap", tmp_path / "new.mcap")
    for name in ("old.mcap", "new.mcap"):
        samples = read_recording(tmp_path / name).samples
        assert samples.dtype.names == ("stamp_ns", "position", "effort", "reference")
        for field in samples.dtype.names:
            np.testing.assert_array_equal(samples[field], rows[field])
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(BadInputError) as caught:
        load_robot(tmp_path / "robot.toml")
    assert caught.value.key == "bus.drive[0].extra[2]"
    assert caught.value.advice == "Write '2081:1' alone"
