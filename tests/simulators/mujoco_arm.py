"""Pairs of recordings of an arm that MuJoCo simulates: the package shares no dynamics with it.

Six joints under a PD at 250 Hz; armature, damping, dry friction; the current goes out in steps of
10 mA. The arm stands on a level floor and carries a box that is bolted to its flange, off its axis.
"""

import hashlib
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np

from acquisition.robot import Payload, Robot, robot_from_files
from identification.data import Signals, signals_from_arrays

GAINS = np.array([12.2, 12.0, 11.6, 10.9, 9.4, 9.8])  # N m/A at the joints
MASS_KG, CENTRE_M = 2.0, (0.02, 0.06, 0.10)
RATE_HZ, SUBSTEPS, SECONDS, STEP_A = 250.0, 8, 8.0, 0.01
# By joint: origin of its frame in the one before, its axis, and mass and centre
# of mass of its link.
CHAIN = (
    ("0 0 0.15", "0 0 1", 7.0, "0 0.02 0.02"),
    ("0 0.15 0", "0 1 0", 12.0, "0.02 0 0.28"),
    ("0 -0.1 0.55", "0 1 0", 4.0, "0 0.02 0.22"),
    ("0 0 0.5", "0 1 0", 2.0, "0.01 0.08 0"),
    ("0 0.13 0", "0 0 1", 2.0, "0 0.01 0.07"),
    ("0 0 0.11", "0 1 0", 0.6, "0.004 0.05 0.002"),
)
ARMATURE = np.array([2.0, 2.0, 1.2, 0.3, 0.3, 0.3])
FRICTION, DAMPING = (
    np.array([6.0, 7.0, 5.0, 1.6, 1.6, 1.4]),
    np.array([9.0, 9.0, 7.0, 2.0, 2.0, 1.8]),
)
# kg m², about what each joint turns: for the gains of the PD
SLIDE = np.array([20.0, 20.0, 10.0, 1.5, 1.5, 1.0])
BANDWIDTH_HZ = 6.0


def body(mass: float, at: str, side: float, name: str) -> str:
    J = mass * side**2 / 6
    inertia = f'<inertia ixx="{J}" iyy="{J}" izz="{J}" ixy="0" ixz="0" iyz="0"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="{at}"/><mass '
        f'value="{mass}"/>{inertia}</inertial></link>'
    )


def urdf(*, loaded: bool) -> str:
    parts = ['<link name="l0"/>']
    for k, (origin, axis, mass, at) in enumerate(CHAIN, 1):
        parts.append(body(mass, at, 0.12 if k < 5 else 0.06, f"l{k}"))
        parts.append(
            f'<joint name="j{k}" type="revolute"><origin xyz="{origin}"/><parent '
            f'link="l{k - 1}"/><child link="l{k}"/>'
            f'<axis xyz="{axis}"/><limit lower="-6" upper="6" velocity="9" effort="999"/></joint>'
        )
    if loaded:
        parts.append(body(MASS_KG, " ".join(map(str, CENTRE_M)), 0.1, "box"))
        parts.append(
            '<joint name="bolts" type="fixed"><parent link="l6"/><child link="box"/></joint>'
        )
    return f'<robot name="six">{"".join(parts)}</robot>'


def robot(catalogue: np.ndarray) -> Robot:
    """The arm by its URDF, with the gains of a catalogue."""
    joints = "".join(f'[[joint]]\nname = "j{k}"\ntype = "revolute"\n' for k in range(1, 7))
    motors = "".join(
        f'[[motor]]\nname = "m{k}"\neffort_unit = "A"\ndrive_gain = {gain}\ndrive_gain_unit = "N '
        'm/A"\n'
        for k, gain in enumerate(catalogue, 1)
    )
    text = (
        f'name = "six"\nurdf = "robot.urdf"\n{joints}{motors}[controller]\nbandwidth_hz = '
        f"{BANDWIDTH_HZ}\n"
    )
    return robot_from_files(
        {"robot.toml": text.encode(), "robot.urdf": urdf(loaded=False).encode()}, "robot.toml"
    )


def reference(seed: int) -> np.ndarray:
    """(N, 6) five sines for each joint, from rest to rest."""
    rng, t = np.random.default_rng([11, seed]), np.arange(round(SECONDS * RATE_HZ)) / RATE_HZ
    f, phase = rng.uniform(0.1, 0.9, (5, 6)), rng.uniform(0, 2 * np.pi, (5, 6))
    waves = np.sin(2 * np.pi * f * t[:, None, None] + phase).sum(axis=1)
    ends = np.clip(np.minimum(t, t[-1] - t), 0, 1.0)[:, None]
    pose = np.array([0.0, 0.5, 0.8, -0.4, 0.3, 0.2])
    return pose + ends**3 * (10 - 15 * ends + 6 * ends**2) * 0.28 * waves


@cache
def driven(*, loaded: bool, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Reference, position and current (N, 6) of a run."""
    spec = mujoco.MjSpec.from_string(urdf(loaded=loaded))
    for joint, *of in zip(spec.joints, ARMATURE, FRICTION, DAMPING, strict=True):
        joint.armature, joint.frictionloss, joint.damping[0] = of
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = (
        1 / RATE_HZ / SUBSTEPS,
        mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    )
    data, q_ref, w = mujoco.MjData(model), reference(seed), 2 * np.pi * BANDWIDTH_HZ
    q, current, data.qpos[:] = np.zeros_like(q_ref), np.zeros_like(q_ref), q_ref[0]
    before = np.zeros(6)
    for k, target in enumerate(q_ref):
        q[k] = data.qpos
        error = target - q[k]
        torque = SLIDE * (w**2 * error + 1.4 * w * (error - before) * RATE_HZ)
        before = error
        current[k] = np.round(torque / GAINS / STEP_A) * STEP_A
        data.qfrc_applied[:] = GAINS * current[k]
        mujoco.mj_step(model, data, SUBSTEPS)
    return q_ref, q, current


def pair(
    catalogue: np.ndarray, mass_kg: float = MASS_KG, off_m: tuple[float, float, float] = (0, 0, 0)
) -> list[Signals]:
    """Without and with the box, stated with this mass and `off_m` beside its centre of mass."""
    found, described = list[Signals](), robot(catalogue)
    centre = tuple(x + dx for x, dx in zip(CENTRE_M, off_m, strict=True))
    for loaded in (False, True):
        q_ref, q, current = driven(loaded=loaded, seed=int(loaded))
        one = signals_from_arrays(q, described.joint_effort(current), RATE_HZ, described, q_ref)
        name = f"{hashlib.sha256(one.q.tobytes()).hexdigest()[:8]}.mcap"
        payload = Payload(mass_kg, centre) if loaded else None
        found.append(replace(one, recording=name, payload=payload, effort_timing="command"))
    return found
