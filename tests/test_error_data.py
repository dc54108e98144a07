"""What a caller reads from an error: the file or the place in it, the key, the value, and what was expected."""

from pathlib import Path

import numpy as np
import pytest
from made_up_buses import block as block_of_frames
from made_up_buses import bus_of, bus_text, frame, robot_of
from made_up_recordings import some_samples

from acquisition.errors import AcquisitionError
from acquisition.files import read_columns
from acquisition.recording.rows import check_frames, check_samples
from acquisition.trajectory import check_limits
from acquisition.transport import read_log


def data_of(caught):
    error = caught.value
    return error.place, error.key, error.value, error.expected


@pytest.mark.parametrize(
    ("change", "key", "value", "expected"),
    [
        (("sync_period_s = 0.002", "sync_period_s = 0.002\nsync_can_id = 0x181"), "bus.sync_can_id", 0x181, "0x80, or "),
        (('"6074"', '"2222"'), "bus.drive[0].reference", "2222", "an object of the drive, or one in objects"),
        (("rated_torque_nm = 0.42", ""), "bus.drive[0].rated_torque_nm", None, "the rated value that"),
        (("counts_per_turn = 65536", "counts_per_m = 1.5"), "bus.drive[0].counts_per_m", 1.5, "counts_per_turn"),
        (('"6074"', '"6074"\nreference_rule = "mA"'), "bus.drive[0].reference_rule", "mA", "N m as motor"),
        (("node = 1\n", 'node = 1\ndictionary = "a.eds"\n'), "bus.drive[0].dictionary", "a.eds", ""),
        (("node = 1\n", "node = 1\nextra = ['6078']\n"), "bus.drive[0].rated_current_a", None, "the rated value that 6078:0"),
        (("node = 1\n", "node = 1\nrpdo = [{ objects = ['6040'], number = 5 }]\n"), "bus.drive[0].rpdo[0].can_id", None, "one"),
    ],
)  # fmt: skip
def test_of_a_description(change, key, value, expected):
    text = bus_text(1)
    assert change[0] in text
    with pytest.raises(AcquisitionError) as caught:
        bus_of(robot_of(text.replace(*change, 1)))
    assert data_of(caught)[:3] == ("robot.toml", key, value)
    assert caught.value.expected.startswith(expected)


def test_of_a_table(tmp_path: Path):
    path = tmp_path / "a.csv"
    path.write_text("a,b\n1,2\n3,x y\n")
    with pytest.raises(AcquisitionError) as caught:
        read_columns(path, ["a", "b"], 2)
    assert data_of(caught) == (f"{path}: line 3", "b", "x y", "a number")
    path.write_text("a,b\n1,2\n3,inf\n")
    with pytest.raises(AcquisitionError) as caught:
        read_columns(path, ["a", "b"], 2)
    assert data_of(caught) == (f"{path}: row 2", "b", np.inf, "a finite number")


def test_of_a_recording():
    samples = some_samples(5)
    samples["stamp_ns"][3] = 7
    with pytest.raises(AcquisitionError) as caught:
        check_samples(samples, -1, "a.mcap: /samples")
    assert data_of(caught)[:3] == ("a.mcap: /samples: row 4", "stamp_ns", 7)
    with pytest.raises(AcquisitionError) as caught:
        check_frames(block_of_frames([frame(-1, 0x80)]), "a.mcap: /can/a/frames")
    assert caught.value.place == "a.mcap: /can/a/frames: row 1"


def test_of_a_path():
    robot = robot_of(bus_text(1))
    path = np.zeros((10, 1))
    path[4] = 3.0  # beyond 150 degrees
    with pytest.raises(AcquisitionError) as caught:
        check_limits(path, robot, 0.5, "path.csv")
    assert data_of(caught) == ("path.csv: at 2 s", "position of joint_1", 3.0, "-2.618 to 2.618")
    assert str(caught.value) == "path.csv: at 2 s: position of joint_1 = 3 rad: expected -2.618 to 2.618"


def test_of_a_log(tmp_path: Path):
    path = tmp_path / "a.log"
    path.write_text("(-5.0) can0 080#\n")
    with pytest.raises(AcquisitionError) as caught:
        list(read_log(path))
    assert caught.value.place == f"{path}: frame 1"
    with pytest.raises(AcquisitionError) as caught:
        list(read_log(tmp_path / "a.txt"))
    assert caught.value.place == str(tmp_path / "a.txt")
    assert caught.value.expected == ".log (candump), .asc, .blf or .trc"
