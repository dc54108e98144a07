"""The robot in three dimensions, moved by the data: a URDF's own shapes, or solids drawn about the joints where it has none.

A link is drawn as a bent rod from its joint to the next, first square to the next joint's axis, then along it, which is how a
modified Denavit-Hartenberg table goes (d along x, then r along z) and how most arms are built. Joints are cylinders about
their axes, or a slide on its rail; the last link ends in a tool.
"""

import hashlib
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np
from scipy.spatial.transform import Rotation

from acquisition.files import MESHES, find_mesh
from acquisition.robot import Robot

from ..arrays import Array
from ..data import Signals
from ..design import Excitation
from ..methods import Fit
from ..model import InverseModel
from .panels import Moving, Part, Scene, Solid

POSES_PER_S = 50.0  # as smooth as a screen shows it
MOST_POSES = 15_000  # five minutes of them; a longer recording has fewer a second
_SMALL = 1e-6


def robot_scene(signals: Signals, fit: Fit | None) -> Scene:
    """The measured robot and, where the fit has one, the simulated one as its ghost."""
    dynamics = fit.problem.model if fit else InverseModel(signals.robot)
    fs, N = signals.sample_rate_hz, len(signals.q)
    k = np.arange(0, N, pose_stride(N, fs))
    robots = [_moving(dynamics, "measured", signals.t_s[k], signals.q[k])]
    if fit is not None and fit.iv is not None and fit.iv.simulated is not None:
        m = fit.iv.simulated
        k = np.arange(0, len(m.t_s), pose_stride(len(m.t_s), 1 / (m.t_s[1] - m.t_s[0])))
        t_s = signals.t_s[np.rint(m.t_s[k] * fs).astype(int)]
        t_s[0] = signals.t_s[0]  # until it sets out, it stands where it will
        robots.append(_moving(dynamics, "simulated", t_s, m.q[k], ghost=True))
    title = "robot measured, in blue simulated" if len(robots) > 1 else "robot measured"
    return _scene(dynamics, robots, signals.q, title)


def excitation_scene(excitation: Excitation) -> Scene:
    """The robot along one period of a reference."""
    t_s, q, _, _ = excitation.curves()
    k = np.arange(0, len(q), pose_stride(len(q), 1 / (t_s[1] - t_s[0])))
    dynamics = InverseModel(excitation.robot)
    return _scene(dynamics, [_moving(dynamics, "reference", t_s[k], q[k])], q, "robot along the reference")


def _scene(dynamics: InverseModel, robots: list[Moving], q: Array, title: str) -> Scene:
    """Robots that move over the positions q (N, n), the first in the middle of the picture."""
    solids, floor = _solids(dynamics, q)
    up, urdf = _up(dynamics), _drawable(dynamics.robot)
    corners = _reached(solids, robots[0])
    target = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    size = float(np.linalg.norm(np.ptp(corners, axis=0)))
    size *= 1.5 if urdf is not None else 1.0  # its shapes reach beyond its last joint
    size *= 1.3 if dynamics.robot.n == 1 else 1.0  # a slide comes close to the eye
    side = np.cross(up, [0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    eye = target + size * (0.65 * side + 0.5 * np.cross(up, side) + 0.33 * up)
    return Scene(
        path=("robot",),
        title=title,
        robots=tuple(robots),
        solids=solids,
        urdf=urdf,
        joints=tuple(joint.name for joint in dynamics.robot.joints),
        up=up,
        floor=floor,
        eye=eye,
        target=target,
    )


def _reached(solids: tuple[Solid, ...], robot: Moving) -> Array:
    """Points (m, 3) that the ends of the solids come to: what a picture must hold."""
    points = []
    for k in range(0, len(robot.t_s), max(1, len(robot.t_s) // 100)):
        for s in solids:
            half = 0.5 * s.size[-1 if s.kind == "box" else 0] * Rotation.from_quat(s.turn).apply([0.0, 0.0, 1.0])
            ends = np.array(
                [s.center, s.center + 2 * half] if s.kind == "capsule" else [s.center - half, s.center + half]
            )
            if s.link > 0:
                ends = Rotation.from_quat(robot.turns[k, s.link - 1]).apply(ends) + robot.places[k, s.link - 1]
            points.append(ends)
    return np.concatenate(points)


def pose_stride(N: int, rate_hz: float) -> int:
    """Of how many samples one gives a pose."""
    return max(1, round(rate_hz / POSES_PER_S), -(-N // MOST_POSES))


def _moving(dynamics: InverseModel, key: str, t_s: Array, q: Array, *, ghost: bool = False) -> Moving:
    places, turns = dynamics.placements(q)
    quaternions = Rotation.from_matrix(turns.reshape(-1, 3, 3)).as_quat().reshape(*places.shape[:2], 4)
    return Moving(key=key, t_s=t_s, q=q, places=places, turns=quaternions, ghost=ghost)


def _drawable(robot: Robot) -> str | None:
    """A URDF with shapes of its own, its meshes named by their files; None without shapes, or where a mesh is not found.

    A mesh is taken from the recording. One that is not there is found by its name, unless this is relative: a recording does
    not hold the folder of the URDF.
    """
    if robot.urdf is None:
        return None
    root = ET.fromstring(robot.urdf)
    for link in root.iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)  # a viewer hides them
    shapes = [shape for visual in root.iter("visual") for geometry in visual.iter("geometry") for shape in geometry]
    for mesh in (shape for shape in shapes if shape.tag == "mesh"):
        name = mesh.get("filename", "")
        content = robot.mesh(name)
        file = find_mesh(name) if content is None else _file_of(content, PurePosixPath(name).suffix)
        if file is None:
            return None
        mesh.set("filename", str(file))
    return ET.tostring(root, encoding="unicode") if shapes else None


def _file_of(content: bytes, suffix: str) -> Path | None:
    """A file with a recording's mesh, for Rerun, which reads meshes from files only; removed when the program ends."""
    if suffix.lower() not in MESHES:
        return None
    file = Path(_folder().name) / (hashlib.sha256(content).hexdigest() + suffix)
    file.write_bytes(content)
    return file


@cache
def _folder() -> TemporaryDirectory[str]:
    return TemporaryDirectory(prefix="robot-idim-meshes-")


def _up(dynamics: InverseModel) -> Array:
    """Against gravity; the base's z where there is none."""
    g = dynamics.robot.gravity
    size = float(np.linalg.norm(g))
    return -g / size if size > 0 else np.array([0.0, 0.0, 1.0])


def _scale(dynamics: InverseModel, q: Array) -> float:
    """A length that the robot's parts are drawn in proportion to: its links put end to end, and its slides' travel."""
    places, _ = dynamics.placements(np.zeros((1, dynamics.robot.n)))
    before = [np.zeros(3) if k == 0 else places[0, k - 1] for k in dynamics.parents]
    length = float(sum(np.linalg.norm(p - b) for p, b in zip(places[0], before, strict=True)))
    slides = [j for j, joint in enumerate(dynamics.robot.joints) if joint.type == "prismatic"]
    length += float(sum(np.ptp(q[:, j]) for j in slides))
    return length if length > _SMALL else 1.0


def _solids(dynamics: InverseModel, q: Array) -> tuple[tuple[Solid, ...], float]:
    """Solids of base and links, each in the frame of its link, and the height of the floor along `up`."""
    robot, n, L = dynamics.robot, dynamics.robot.n, _scale(dynamics, q)
    places, turns = (x[0] for x in dynamics.placements(np.zeros((1, n))))
    axes = _axes(dynamics)  # in the links' own frames
    up, out = _up(dynamics), list[Solid]()
    radii = L * np.linspace(0.075, 0.042, n) if n > 1 else np.array([0.06 * L])
    parents = dynamics.parents
    floor = 0.0
    for j, joint in enumerate(robot.joints):
        parent, rho = parents[j], float(radii[j])
        slides, axis = joint.type == "prismatic", axes[j]
        back = np.eye(3) if parent == 0 else turns[parent - 1].T
        origin = np.zeros(3) if parent == 0 else places[parent - 1]
        to, along = back @ (places[j] - origin), back @ turns[j] @ axis
        corner = to - (to @ along) * along
        thick = 0.8 * float(radii[max(0, parent - 1)])
        for a, b in ((np.zeros(3), corner), (corner, to)):
            if np.linalg.norm(b - a) > _SMALL:
                out.append(_rod(parent, a, b, thick))
        if slides:
            low, high = min(0.0, float(q[:, j].min())), max(0.0, float(q[:, j].max()))
            a, b = to + (low - 1.6 * rho) * along, to + (high + 1.6 * rho) * along
            out.append(_bar(parent, a, b, 0.7 * rho, "base" if parent == 0 else "link"))
            out.append(_box(j + 1, axis, np.array([2.6 * rho, 2.6 * rho, 2.6 * rho]), "joint"))
        else:
            out.append(_cylinder(j + 1, -1.25 * rho * axis, 1.25 * rho * axis, rho, "joint"))
        if parent == 0 and not slides and np.linalg.norm(to) < 0.05 * L:  # a stand, or the robot would float
            level = abs(along @ up) < 0.5
            foot = to - (0.75 * L * up if level else 0.35 * L * along)
            out.append(_cylinder(0, to, foot, 0.8 * rho, "base"))
            plate = up if level else along
            out.append(_cylinder(0, foot, foot - 0.25 * rho * plate, 2.2 * rho, "base"))
            floor = min(floor, float((foot - 0.25 * rho * plate) @ up))
        elif parent == 0 and not slides:
            plate = to / np.linalg.norm(to)
            out.append(_cylinder(0, np.zeros(3), 0.25 * rho * plate, 2.2 * rho, "base"))
        elif parent == 0:
            floor = min(floor, float(to @ up) - 1.3 * rho)
    for j in range(n):
        if j + 1 not in parents:
            out += _tool(dynamics, j, axes, float(radii[j]), L, turns)
    return tuple(out), floor


def _tool(dynamics: InverseModel, j: int, axes: Array, rho: float, L: float, turns: Array) -> list[Solid]:
    """What the last link j ends in: an arm to the side of parallel axes, else a flange with two fingers that show turns."""
    joints, parent = dynamics.robot.joints, dynamics.parents[j]
    if joints[j].type == "prismatic":
        return [] if dynamics.robot.n == 1 else [_cylinder(j + 1, np.zeros(3), 2.6 * rho * axes[j], 0.6 * rho, "tool")]
    across = parent == 0 or abs(turns[parent - 1] @ axes[parent - 1] @ (turns[j] @ axes[j])) > 0.99
    if across:
        x = np.cross(axes[j], [0.0, 0.0, 1.0] if abs(axes[j][2]) < 0.5 else [0.0, 1.0, 0.0])
        x = -x if x[0] < 0 else x
        reach = 0.6 * L if dynamics.robot.n > 1 else 0.75 * L
        end = reach * x / np.linalg.norm(x)
        return [
            _rod(j + 1, np.zeros(3), end, 0.7 * rho),
            _cylinder(j + 1, end - rho * axes[j], end + rho * axes[j], 0.9 * rho, "tool"),
        ]
    a = axes[j]
    x = np.cross(a, [0.0, 0.0, 1.0] if abs(a[2]) < 0.5 else [0.0, 1.0, 0.0])
    flange = _cylinder(j + 1, 1.2 * rho * a, 2.2 * rho * a, 0.8 * rho, "tool")
    fingers = [
        _bar(j + 1, 2.2 * rho * a + s * rho * x, 4.4 * rho * a + s * rho * x, 0.3 * rho, "tool") for s in (-0.6, 0.6)
    ]
    return [flange, *fingers]


def _axes(dynamics: InverseModel) -> Array:
    """(n, 3) the joints' axes in the frames of their links."""
    n = dynamics.robot.n
    places, turns = dynamics.placements(np.concatenate([np.zeros((1, n)), np.eye(n)]))
    axes = np.empty((n, 3))
    for j, joint in enumerate(dynamics.robot.joints):
        if joint.type == "prismatic":
            axes[j] = turns[0, j].T @ (places[j + 1, j] - places[0, j])
        else:
            axes[j] = Rotation.from_matrix(turns[0, j].T @ turns[j + 1, j]).as_rotvec()
    return np.asarray(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def _from_z(direction: Array) -> Array:
    """Quaternion (4,) that turns z into a direction."""
    z = direction / np.linalg.norm(direction)
    return np.asarray(Rotation.align_vectors([z], [[0.0, 0.0, 1.0]])[0].as_quat())


def _rod(link: int, a: Array, b: Array, radius: float) -> Solid:
    size = (float(np.linalg.norm(b - a)), radius)
    return Solid(link=link, kind="capsule", size=size, center=a, turn=_from_z(b - a), part="link" if link else "base")


def _cylinder(link: int, a: Array, b: Array, radius: float, part: Part) -> Solid:
    size = (float(np.linalg.norm(b - a)), radius)
    return Solid(link=link, kind="cylinder", size=size, center=0.5 * (a + b), turn=_from_z(b - a), part=part)


def _bar(link: int, a: Array, b: Array, width: float, part: Part) -> Solid:
    size = (width, width, float(np.linalg.norm(b - a)))
    return Solid(link=link, kind="box", size=size, center=0.5 * (a + b), turn=_from_z(b - a), part=part)


def _box(link: int, axis: Array, size: Array, part: Part) -> Solid:
    return Solid(link=link, kind="box", size=tuple(size), center=np.zeros(3), turn=_from_z(axis), part=part)
