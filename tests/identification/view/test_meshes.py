"""Meshes of a URDF that a recording carries: the robot is drawn by them on a machine that
does not have their files.
"""

import shutil

import numpy as np
import pytest
from made_up_recordings import header, some_samples
from pictured_fits import Written, urdf_robot

from acquisition.errors import BadInputError
from acquisition.files import meshes
from acquisition.recording import RecordingWriter, read_recording
from acquisition.robot import load_robot, robot_from_files
from identification.data import load_signals
from identification.regression import Overrides
from identification.view import draw_recording, write_rrd

# A binary STL of one triangle: 80 bytes of header, the count, then normal,
# corners and an attribute.
TRIANGLE = (
    bytes(80)
    + np.uint32(1).tobytes()
    + np.float32([0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0]).tobytes()
    + bytes(2)
)


def described(folder, name="meshes/l.stl", asked="urdf_meshes = true\n"):
    made = urdf_robot(f"<mesh filename='{name}'/>")
    (folder / "meshes").mkdir(parents=True, exist_ok=True)
    (folder / "meshes" / "l.stl").write_bytes(TRIANGLE)
    (folder / "arm.urdf").write_text(made.urdf)
    (folder / "robot.toml").write_text(asked + made.files["robot.toml"].decode())
    return folder / "robot.toml"


def recorded(path, robot):
    with RecordingWriter(path, header(robot)) as writer:
        writer.samples(some_samples(300))
    return path


def meshes_drawn(path, tmp_path):
    write_rrd(tmp_path / "view.rrd", draw_recording(load_signals(path), Overrides()))
    shapes = [
        c
        for path, c in Written(tmp_path / "view.rrd").static.items()
        if "/visual_geometries/" in path
    ]
    return [bytes(c["Asset3D:blob"][0]) for c in shapes if "Asset3D:blob" in c]


@pytest.mark.parametrize("name", ["meshes/l.stl", "package://arm/meshes/l.stl"])
def test_recording_in_other_folder_keeps_meshes(name, tmp_path):
    path = recorded(tmp_path / "log.mcap", load_robot(described(tmp_path / "arm", name)))
    (tmp_path / "elsewhere").mkdir()
    moved = path.rename(tmp_path / "elsewhere" / "log.mcap")
    shutil.rmtree(tmp_path / "arm")
    assert read_recording(moved).robot.mesh(name) == TRIANGLE
    assert meshes_drawn(moved, tmp_path) == [TRIANGLE] * 3, "one of each link"


def test_meshes_attached_only_on_request(tmp_path):
    robot = load_robot(described(tmp_path / "arm", asked=""))
    assert set(robot.files) == {"robot.toml", "robot.urdf"}
    assert meshes_drawn(recorded(tmp_path / "log.mcap", robot), tmp_path) == []


def test_unknown_mesh_format_not_written(tmp_path):
    files = dict(load_robot(described(tmp_path / "arm")).files)
    content = files.pop("mesh:meshes/l.stl")
    files |= {
        "robot.urdf": files["robot.urdf"].replace(b"l.stl", b"../../../l.sh"),
        "mesh:meshes/../../../l.sh": content,
    }
    path = recorded(tmp_path / "log.mcap", robot_from_files(files, "a recording"))
    assert meshes_drawn(path, tmp_path) == []


@pytest.mark.parametrize(
    "name", ["meshes/none.stl", "package://other/meshes/l.stl", "meshes/l.txt"]
)
def test_missing_mesh_refused(name, tmp_path):
    path = described(tmp_path, name)
    (tmp_path / "meshes" / "l.txt").write_text("text")
    with pytest.raises(BadInputError, match="does not exist") as caught:
        load_robot(path)
    assert (caught.value.place, caught.value.key, caught.value.value) == (
        str(path),
        "urdf: mesh",
        name,
    )


def test_unattachable_recording_refused(tmp_path, monkeypatch):
    path = described(tmp_path)
    monkeypatch.setattr(meshes, "MAX_MESH_BYTES", 133)
    with pytest.raises(BadInputError, match="the meshes have 134 bytes, more than 133"):
        load_robot(path)
    (tmp_path / "arm.urdf").write_text("<robot>")
    with pytest.raises(BadInputError, match="urdf: the file is not valid XML: no element found"):
        load_robot(path)
    path.write_text(path.read_text().replace('urdf = "arm.urdf"\n', ""))
    with pytest.raises(BadInputError, match=r"urdf_meshes = True: robot.toml has no urdf"):
        load_robot(path)
