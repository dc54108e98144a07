"""Robots and fits made up for pictures, and the Rerun files of them read back."""

from functools import cache

import numpy as np
from conftest import robot_named
from rerun.chunk import RrdReader

from acquisition.robot import robot_from_files
from identification.data import Signals
from identification.methods import Iteration
from identification.model import InverseModel, base_parameters
from identification.regression import Motion, Overrides, differentiate, predicted_torque
from identification.report import Parameter, ParameterSet
from identification.results import identify_iv, identify_ls
from identification.study import Noise, closed_loop, random_reference

FS = 1000.0


def robot_with(types, unit):
    text = 'name = "made up"\n'
    for j, kind in enumerate(types):
        dh = (
            f"{{ alpha_deg = {(0, -90, 90)[j % 3]}, d_m = {0.2 * (j > 0)}, theta_deg = 0, r_m "
            f"= {0.1 * j} }}"
        )
        text += f'[[joint]]\nname = "joint {j + 1}.x"\ntype = "{kind}"\ndh = {dh}\noffset = true\n'
        text += (
            f"rotor_inertia = {'true' if j else 'false'}\n[[motor]]\nname = "
            f'"m{j}"\neffort_unit = "{unit}"\n'
        )
    return robot_from_files(
        {"robot.toml": (text + "[controller]\nbandwidth_hz = 10.0\n").encode()}, "made up"
    )


@cache
def made_up(types=("revolute", "prismatic"), unit="N m", samples=4000, reference=False, noise=1e-6):
    """A robot that obeys its model, with noise on position and torque."""
    rng = np.random.default_rng(5)
    robot, t = robot_with(types, unit), np.arange(samples) / FS
    f = np.array([0.3, 0.7, 1.1, 1.9, 2.3])[:, None, None] * 4000 / samples + 0.5
    phase, size = rng.uniform(0, 6, (5, 1, robot.n)), rng.uniform(0.1, 0.3, (5, 1, robot.n))
    q = (size * np.sin(2 * np.pi * f * t[:, None] + phase)).sum(axis=0)
    dq = differentiate(q, FS)
    motion = Motion(t_s=t, q=q, dq=dq, ddq=differentiate(dq, FS), tau=np.zeros_like(q))
    idm = InverseModel(robot)
    base = base_parameters(idm)
    tau = predicted_torque(motion, idm, base, rng.uniform(0.5, 2, base.b))
    return Signals(
        t_s=t,
        q=q + noise * rng.standard_normal(q.shape),
        q_ref=q + 0.01 if reference else None,
        effort=tau + 0.05 * tau.std() * rng.standard_normal(tau.shape),
        sample_rate_hz=FS,
        track=None,
        robot=robot,
        recording="made_up.mcap",
        sha256="0" * 64,
    )


@cache
def fitted(signals, cutoff_hz=None, essential=False):
    return identify_ls(signals, Overrides(cutoff_hz=cutoff_hz), essential=essential)


@cache
def fitted_iv(signals):
    return identify_iv(signals, Overrides(), Iteration())


@cache
def scara():
    """A robot that can be simulated, tracking a reference."""
    robot = robot_named("scara")
    q_ref = random_reference(robot, duration_s=6.0, sample_rate_hz=FS, seed=1)
    return closed_loop(robot, q_ref, FS, noise=Noise(effort_percent=1.0), seed=1)


class Written:
    """A file read back: `curves` as (t_ns, values) and `static` columns by entity
    path; the layout's views.
    """

    def __init__(self, path):
        reader = RrdReader(path)
        (recording,), (blueprint,) = reader.recordings(), reader.blueprints()
        self.application = recording.application_id
        self.curves, self.static, self.views, self.moving = {}, {}, {}, {}
        for chunk in reader.stream(store=recording).to_chunks():
            batch = chunk.to_record_batch()
            columns = {name: batch.column(name) for name in batch.schema.names}
            if chunk.is_static:
                self.static.setdefault(chunk.entity_path, {}).update(
                    {k: v.to_pylist()[0] for k, v in columns.items()}
                )
            else:
                (timeline,) = chunk.timeline_names
                assert timeline == "time"
                if "Scalars:scalars" not in columns:
                    assert chunk.entity_path not in self.moving, "in one piece"
                    self.moving[chunk.entity_path] = {
                        name: c.to_pylist() for name, c in columns.items()
                    }
                    continue
                t = columns["time"].to_numpy(zero_copy_only=False).astype(np.int64)
                x = np.array([row[0] for row in columns["Scalars:scalars"].to_pylist()])
                assert chunk.entity_path not in self.curves, "in one piece"
                self.curves[chunk.entity_path] = (t, x)
        for chunk in reader.stream(store=blueprint).to_chunks():
            batch = chunk.to_record_batch()
            if "ViewBlueprint:space_origin" in batch.schema.names:
                kind, title, origin = (
                    batch.column(f"ViewBlueprint:{name}").to_pylist()[0][0]
                    for name in ("class_identifier", "display_name", "space_origin")
                )
                self.views["/" + origin.lstrip("/")] = (kind, title)

    def curve(self, *path):
        t, x = self.curves["/" + "/".join(part.replace(" ", "\\ ") for part in path)]
        return np.rint(t * 1e-9 * FS).astype(int), x

    def holds(self, origin, kind):
        """Whether there is something below `origin` that a view of this kind shows."""
        below = {
            path: columns
            for path, columns in self.static.items()
            if f"{path}/".startswith(f"{origin}/")
        }
        if kind == "TimeSeries":
            lines = [
                p for p in self.curves if p.startswith(f"{origin}/") and len(self.curves[p][0]) > 1
            ]
            return len(lines) > 0
        if kind == "TextLog":
            return any(
                "TextLog:text" in c
                for p, c in self.moving.items()
                if f"{p}/".startswith(f"{origin}/")
            )
        if kind == "2D":
            return all(f"{origin}/{key}" in below for key in ("lines", "points", "texts"))
        if kind == "3D":
            solids = [
                columns
                for columns in below.values()
                if any(name.endswith(("sizes", "radii")) for name in columns)
            ]
            moved = [
                p
                for p, c in self.moving.items()
                if p.startswith(f"{origin}/") and "Transform3D:translation" in c
            ]
            return len(solids) > 0 and len(moved) > 0
        return any(columns.get("TextDocument:text") for columns in below.values())

    def is_complete(self):
        """No view of the layout is empty, and nothing in the file is without a view."""
        for origin, (kind, title) in self.views.items():
            assert self.holds(origin, kind), f"{title} is empty"
        for path in [*self.curves, *self.static, *self.moving]:
            assert path.startswith("/__") or any(
                f"{path}/".startswith(f"{origin}/") for origin in self.views
            ), path
        return True


LINK = (
    "<inertial><mass value='1'/><inertia ixx='.1' iyy='.1' izz='.1' ixy='0' ixz='0' "
    "iyz='0'/></inertial>"
)


def urdf_robot(shape):
    visual = f"<visual><geometry>{shape}</geometry></visual>"
    joint = (
        "<joint name='{0}' type='revolute'><parent link='{1}'/><child link='{2}'/><origin xyz='0 0 "
        ".4'/><axis xyz='0 1 0'/><limit lower='-1' upper='1' effort='1' velocity='1'/></joint>"
    )
    urdf = (
        f"<robot name='arm'><link name='base'>{visual}</link><link name='l1'>{LINK}{visual}</link>"
    )
    urdf += (
        f"<link name='l2'>{LINK}{visual}</link>"
        f"{joint.format('a', 'base', 'l1')}{joint.format('b', 'l1', 'l2')}</robot>"
    )
    text = 'name = "arm"\nurdf = "arm.urdf"\n[controller]\nbandwidth_hz = 10.0\n'
    for name in "ab":
        text += (
            f'[[joint]]\nname = "{name}"\ntype = "revolute"\n[[motor]]\nname = '
            f'"m{name}"\neffort_unit = "N m"\n'
        )
    return robot_from_files({"robot.toml": text.encode(), "robot.urdf": urdf.encode()}, "made up")


def values(label, **parameters):
    return ParameterSet(
        label=label,
        parameters={
            name: Parameter(name=name, value=v, sigma=s, unit="kg", essential=True)
            for name, (v, s) in parameters.items()
        },
    )
