"""Arms of URDFs that pinocchio moves: what a table or a log of them holds, and the true torque.

Pinocchio reads the URDF itself, all joints but the arm's fixed; friction, rotors and noise are
added here. The package uses pinocchio too, so that what is compared is everything around it:
frames, units, order, base parameters and what is written for other programs.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pinocchio as pin

Array = np.ndarray
Torque = Callable[[Array, Array, Array], Array]  # (N, n) along q, dq, ddq
BANDWIDTH_HZ, DAMPING, STEPS = 8.0, 1.4, 3  # of the loops; steps of Runge-Kutta in a period
NOISE_RAD, NOISE_OF_TORQUE = 1e-5, 0.01
UNSEEN = 77  # seed of the motion at which errors are counted


@dataclass(frozen=True, kw_only=True)
class Arm:
    """Joints (n,) of a URDF, with Fv, Fc and Ia in SI of the joint."""

    model: pin.Model
    joints: tuple[str, ...]
    slides: Array
    range: Array  # (n, 2)
    speed: Array
    Fv: Array
    Fc: Array
    Ia: Array
    mu: Array | float = 0.0  # load friction, share of the torque of the links

    def motion(self, seed: int, seconds: float, rate_hz: float) -> tuple[Array, Array, Array]:
        """Position, speed and acceleration (N, n): sines up to 0.8 Hz within the limits."""
        rng, t = np.random.default_rng(seed), np.arange(round(seconds * rate_hz)) / rate_hz
        w, paths = 0.2 * np.pi * np.arange(1, 9), []
        for (low, high), speed in zip(self.range, self.speed, strict=True):
            sizes, phases = rng.normal(size=8) / np.sqrt(w), rng.uniform(0, 2 * np.pi, 8)
            waves = np.outer(t, w) + phases
            path = np.array(
                [
                    np.sin(waves) @ sizes,
                    np.cos(waves) @ (sizes * w),
                    -np.sin(waves) @ (sizes * w**2),
                ]
            )
            widest = min(1.2, 0.45 * (high - low))
            path *= min(widest / abs(path[0]).max(), 0.8 * speed / abs(path[1]).max())
            path[0] += np.clip(0.0, low + widest, high - widest)
            paths.append(path)
        q, dq, ddq = np.stack(paths, axis=-1)
        return q, dq, ddq

    def torque(self, q: Array, dq: Array, ddq: Array) -> Array:
        """(N, n) of the joints."""
        data = self.model.createData()
        rows = [pin.rnea(self.model, data, *row) for row in zip(q, dq, ddq, strict=True)]
        links = np.array(rows)
        dry = self.Fc + self.mu * np.abs(links)
        return links + self.Fv * dq + dry * np.sign(dq) + self.Ia * ddq

    def measured(self, seed: int, seconds: float, rate_hz: float) -> tuple[Array, Array]:
        """Position and torque (N, n) along a motion, both with noise."""
        path, rng = self.motion(seed, seconds, rate_hz), np.random.default_rng(seed)
        torque = self.torque(*path)
        noise = NOISE_OF_TORQUE * torque.std(axis=0) * rng.normal(size=torque.shape)
        return path[0] + NOISE_RAD * rng.normal(size=torque.shape), torque + noise

    def driven(self, seed: int, seconds: float, rate_hz: float) -> tuple[Array, Array, Array]:
        """Position, torque and reference (N, n) of a PD that holds the arm to a motion, both with
        noise.
        """
        model, rng, data = self.model.copy(), np.random.default_rng(seed), self.model.createData()
        model.armature[:] = self.Ia
        (q_ref, dq_ref, _), w = self.motion(seed, seconds, rate_hz), 2 * np.pi * BANDWIDTH_HZ
        stiff = np.diag(pin.crba(model, data, q_ref.mean(axis=0))) * w**2
        damp, h, rubs = DAMPING * stiff / w, 1 / rate_hz / STEPS, np.any(self.mu)

        def speeds(x: Array, torque: Array) -> Array:
            (q, dq), a = x, None
            for times in range(4 if rubs else 1):  # the load is that of the acceleration
                load = np.abs(pin.rnea(self.model, data, q, dq, a)) if times else 0.0
                dry = (self.Fc + self.mu * load) * np.tanh(dq / (0.003 * self.speed))
                a = pin.aba(model, data, q, dq, torque - self.Fv * dq - dry)
            return np.array([dq, a])

        x, q, torque = np.array([q_ref[0], dq_ref[0]]), np.empty_like(q_ref), np.empty_like(q_ref)
        before = np.zeros(model.nv)
        for k, target in enumerate(q_ref):
            q[k] = x[0] + NOISE_RAD * rng.normal(size=model.nv)
            error = target - q[k]
            u = torque[k] = stiff * error + damp * (error - before) * rate_hz
            before = error
            for _ in range(STEPS):
                a = speeds(x, u)
                b = speeds(x + h / 2 * a, u)
                c = speeds(x + h / 2 * b, u)
                x = x + h / 6 * (a + 2 * b + 2 * c + speeds(x + h * c, u))
        noise = NOISE_OF_TORQUE * torque.std(axis=0) * rng.normal(size=torque.shape)
        return q, torque + noise, q_ref

    def errors_percent(self, torque: Torque) -> Array:
        """(n,) relative error of a torque along a motion that no recording has."""
        path = self.motion(UNSEEN, 6.0, 100.0)
        true = self.torque(*path)
        return 100 * np.linalg.norm(torque(*path) - true, axis=0) / np.linalg.norm(true, axis=0)


def arm_of(urdf: str, joints: Sequence[str]) -> Arm:
    """The arm of these joints, whose friction and rotors are shares of effort and speed of the
    URDF.
    """
    root, moved = ET.fromstring(urdf), {}
    for joint in root.findall("joint"):
        if joint.get("name") in joints:
            moved[joint.get("name")] = (joint.get("type"), dict(joint.find("limit").items()))
            joint.set("type", "prismatic" if joint.get("type") == "prismatic" else "revolute")
        else:
            joint.set("type", "fixed")
        for part in [*joint.findall("limit"), *joint.findall("mimic")]:
            joint.remove(part)
        ET.SubElement(joint, "limit", lower="-9", upper="9", effort="9e9", velocity="9")
    kinds, limits = zip(*(moved[name] for name in joints), strict=True)
    effort, speed, low, high = (
        np.array([float(one.get(key, default)) for one in limits])
        for key, default in (("effort", 0), ("velocity", 0), ("lower", -9), ("upper", 9))
    )
    model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    assert tuple(model.names)[1:] == tuple(joints)
    return Arm(
        model=model, joints=tuple(joints), slides=np.array(kinds) == "prismatic",
        range=np.column_stack([low, high]), speed=speed,
        Fv=0.05 * effort / speed, Fc=0.03 * effort, Ia=0.01 * effort / speed,
    )  # fmt: skip


def mujoco_torque(path: str) -> Torque:
    """Inverse dynamics (N, n) of a model file by MuJoCo; its dry friction by the formula."""
    model = mujoco.MjModel.from_xml_path(path)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)

    def torque(*motion: Array) -> Array:
        rows = []
        for data.qpos[:], data.qvel[:], data.qacc[:] in zip(*motion, strict=True):
            mujoco.mj_inverse(model, data)
            rows.append(data.qfrc_inverse + model.dof_frictionloss * np.sign(data.qvel))
        return np.array(rows)

    return torque
