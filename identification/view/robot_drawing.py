"""The moving robot in three dimensions.

It is drawn by the shapes of its URDF, or by a URDF made from its model.
"""

import hashlib
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from acquisition.files import MESHES, find_mesh
from acquisition.robot import Robot

from ..arrays import Array
from ..data import Signals
from ..design import Excitation
from ..export import make_urdf
from ..model import InverseModel
from ..results import FitOnRecording
from .panels import Moving, Scene

POSES_PER_S = 50.0  # close to the frame rate of a screen
MAX_POSES = 15_000  # five minutes; a longer recording has fewer poses per second
MARGIN_M = 0.1  # that shapes extend beyond the origins of their joints
HALF_VIEW = np.array([0.6, 0.5])  # half the picture over its distance; the camera has 55° upright
# To the right, upwards, and to the eye, in directions that are level, level and up.
CAMERA = np.array([[-3, 3, 0], [-1, -1, 4], [8**0.5, 8**0.5, 2**0.5]]) / 18**0.5


def robot_scene(signals: Signals, fit: FitOnRecording | None) -> Scene:
    """Return the measured robot and, if the fit simulated it, the simulated one as a ghost."""
    fs, N = signals.sample_rate_hz, len(signals.q)
    k = np.arange(0, N, pose_stride(N, fs))
    robots = [Moving(key="measured", t_s=signals.t_s[k], q=signals.q[k])]
    if fit and fit.simulated and (m := fit.simulated.motion):
        k = np.arange(0, len(m.t_s), pose_stride(len(m.t_s), 1 / (m.t_s[1] - m.t_s[0])))
        t_s = signals.t_s[np.rint(m.t_s[k] * fs).astype(int)]
        t_s[0] = signals.t_s[0]  # before the simulation starts, the ghost stands at its first pose
        robots.append(Moving(key="simulated", t_s=t_s, q=m.q[k], ghost=True))
    return _scene(
        fit.problem.model if fit else InverseModel(signals.robot),
        robots,
        signals.q,
        "measured robot, simulated robot in blue" if len(robots) > 1 else "measured robot",
    )


def excitation_scene(excitation: Excitation) -> Scene:
    """Return the robot along one period of a reference."""
    t_s, q, _, _ = excitation.curves()
    k = np.arange(0, len(q), pose_stride(len(q), 1 / (t_s[1] - t_s[0])))
    return _scene(
        InverseModel(excitation.robot),
        [Moving(key="reference", t_s=t_s[k], q=q[k])],
        q,
        "robot along the reference",
    )


def _scene(dynamics: InverseModel, robots: list[Moving], q: Array, title: str) -> Scene:
    """Return robots in a view that the motion q (N, n) just fits into."""
    against = -dynamics.robot.gravity
    up = against / np.linalg.norm(against) if against.any() else np.array([0.0, 0.0, 1.0])
    places, _ = dynamics.placements(q[:: max(1, len(q) // 100)])
    points = np.concatenate([np.zeros((1, 3)), places.reshape(-1, 3)])
    target = 0.5 * (points.min(axis=0) + points.max(axis=0))
    side = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    axes = CAMERA @ np.array([side, np.cross(up, side), up])
    seen = (points - target) @ axes.T
    needed = (np.abs(seen[:, :2]) + MARGIN_M) / HALF_VIEW + seen[:, 2:]
    return Scene(
        path=("robot",),
        title=title,
        robots=tuple(robots),
        urdf=_drawable(dynamics.robot) or make_urdf(dynamics),
        joints=tuple(joint.name for joint in dynamics.robot.joints),
        up=up,
        floor=float((points @ up).min()),
        eye=target + needed.max() * axes[2],
        target=target,
    )


def pose_stride(N: int, rate_hz: float) -> int:
    """Return the number of samples from one drawn pose to the next."""
    return max(1, round(rate_hz / POSES_PER_S), -(-N // MAX_POSES))


def _drawable(robot: Robot) -> str | None:
    """Return the robot's URDF with files of its meshes, of the recording or by their names.

    It is None without shapes or a mesh.
    """
    if robot.urdf is None:
        return None
    root = ET.fromstring(robot.urdf)
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)  # the viewer hides them
    shapes = [
        shape
        for visual in root.iter("visual")
        for geometry in visual.iter("geometry")
        for shape in geometry
    ]
    for mesh in (shape for shape in shapes if shape.tag == "mesh"):
        name = mesh.get("filename", "")
        content = robot.mesh(name)
        file = (
            find_mesh(name) if content is None else _write_mesh(content, PurePosixPath(name).suffix)
        )
        if file is None:
            return None
        mesh.set("filename", str(file))
    return ET.tostring(root, encoding="unicode") if shapes else None


def _write_mesh(content: bytes, suffix: str) -> Path | None:
    """Write a recording's mesh to a file for Rerun, which reads only files.

    The file is removed when the program ends.
    """
    if suffix.lower() not in MESHES:
        return None
    file = Path(_folder().name) / (hashlib.sha256(content).hexdigest() + suffix)
    file.write_bytes(content)
    return file


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="robot-idim-meshes-")
