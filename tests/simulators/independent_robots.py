"""Equations of motion of the shipped robots, written a second time: nothing here is
the package's dynamics.

`plant` reads a robot.toml with tomllib and gives the robot's plant: rigid bodies by spatial
vectors at the world's origin (Featherstone 2008, chapters 2 and 5), in one pass without a
recursion over forces; friction tanh(v/v0); rotors and friction of motors through the coupled
wrist; cogging, a payload.
States are batches (S, n): one row for each run that is simulated at the same time.
"""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray
Rigid = Callable[[Array, Array], tuple[Array, Array]]

LINK = ("XX", "XY", "XZ", "YY", "YZ", "ZZ", "MX", "MY", "MZ", "M")
EYE = np.eye(3)
# a @ TURNS is [a]x, row by row.
TURNS = np.zeros((3, 9))
TURNS[[2, 0, 1], [3, 7, 2]], TURNS[[2, 0, 1], [1, 5, 6]] = 1.0, -1.0


def skew(a: Array) -> Array:
    """[a]x (..., 3, 3) with [a]x b = a x b."""
    return (a @ TURNS).reshape(*a.shape, 3)


@dataclass(frozen=True, kw_only=True)
class Chain:
    """A serial chain of rigid bodies.

    Modified Denavit-Hartenberg frames: Rot(x, alpha) Trans(x, d) Rot(z, theta) Trans(z, r).

    alpha, d, theta, r, prismatic: (n,). inertia (n, 3, 3) and moment (n, 3) about and from the
    origin of each link's frame, mass (n,). gravity (3,) in the world's frame.
    """

    alpha: Array
    d: Array
    theta: Array
    r: Array
    prismatic: Array
    inertia: Array
    moment: Array
    mass: Array
    gravity: Array

    def __call__(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """M (S, n, n) and the torques (S, n) of speed and gravity, at the states q, dq (S, n)."""
        runs, n = q.shape
        axis, origin, rotation = self._frames(q)
        # Of each joint and body: what turns or acts about the origin, and what moves it.
        S = np.zeros((runs, n, 2, 3))
        S[:, :, 0] = ~self.prismatic[:, None] * axis
        S[:, :, 1] = (skew(origin) @ S[:, :, 0, :, None])[..., 0] + self.prismatic[:, None] * axis
        V = (S * dq[..., None, None]).cumsum(axis=1)
        turns, shifts = np.moveaxis(skew(V), 2, 0)
        turned = S @ turns.swapaxes(-1, -2)
        turned[:, :, 1] += (shifts @ S[:, :, 0, :, None])[..., 0]
        A = (turned * dq[..., None, None]).cumsum(axis=1)
        A[:, :, 1] -= self.gravity
        inertia = self._at_the_origin(origin, rotation)  # (S, n, 6, 6)
        momentum, force = (
            (inertia @ x.reshape(runs, n, 6, 1)).reshape(runs, n, 2, 3) for x in (V, A)
        )
        force += momentum @ turns.swapaxes(-1, -2)
        force[:, :, 0] += (shifts @ momentum[:, :, 1, :, None])[..., 0]
        flat = S.reshape(runs, n, 6)
        bias = (S * force[:, ::-1].cumsum(axis=1)[:, ::-1]).sum(axis=(-1, -2))
        # momentum of all that joint k carries, for unit speed of joint k
        moved = (inertia[:, ::-1].cumsum(axis=1)[:, ::-1] @ flat[..., None])[..., 0]
        M = flat @ moved.transpose(0, 2, 1)  # entry (j, k) holds for j <= k
        return np.where(np.tri(n, dtype=bool), M.transpose(0, 2, 1), M), bias

    def _frames(self, q: Array) -> tuple[Array, Array, Array]:
        """Axis and origin (S, n, 3) and rotation (S, n, 3, 3) of each
        link's frame, in the world.
        """
        turn = self.theta + np.where(self.prismatic, 0.0, q)
        slide = self.r + np.where(self.prismatic, q, 0.0)
        c, s, ca, sa = np.cos(turn), np.sin(turn), np.cos(self.alpha), np.sin(self.alpha)
        zero = np.zeros_like(c)
        # of each link in the frame of the one before
        local = np.stack(
            [
                *(c, -s, zero, zero + self.d),
                *(ca * s, ca * c, zero - sa, -sa * slide),
                *(sa * s, sa * c, zero + ca, ca * slide),
                *(zero, zero, zero, zero + 1),
            ],
            axis=-1,
        )
        world = carried_on(local.reshape(*q.shape, 4, 4))
        return world[..., :3, 2], world[..., :3, 3], world[..., :3, :3]

    def _at_the_origin(self, p: Array, rotation: Array) -> Array:
        """Spatial inertias (S, n, 6, 6) of the links about the world's origin, p
        being their own origins.
        """
        m = (rotation @ self.moment[..., None])[..., 0]
        about = rotation @ self.inertia @ rotation.swapaxes(-1, -2)
        pm, M = p[..., :, None] * m[..., None, :], self.mass[:, None, None]
        shift = pm + pm.swapaxes(-1, -2) + M * (p[..., :, None] * p[..., None, :])
        h, out = skew(m + self.mass[:, None] * p), np.empty((*p.shape[:-1], 6, 6))
        out[..., :3, :3] = about + np.einsum("...kk", shift)[..., None, None] * EYE - shift
        out[..., :3, 3:], out[..., 3:, :3], out[..., 3:, 3:] = h, -h, M * EYE
        return out


def carried_on(local: Array) -> Array:
    """Places of all links in the world (S, n, 4, 4) by that of each in the link before it."""
    world = local.copy()
    for j in range(1, local.shape[1]):
        world[:, j] = world[:, j - 1] @ local[:, j]
    return world


def scara(q: Array, dq: Array) -> tuple[Array, Array]:
    """The closed form of section 4 of Janot2014 with its values: what `Chain` gives of
    the SCARA, much faster.
    """
    ZZ1R, ZZ2, LMX2, LMY2 = 3.45, 0.061, 0.123, 0.007
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    v1, v2 = dq.T
    near, across = LMX2 * c2 - LMY2 * s2, LMX2 * s2 + LMY2 * c2
    M, bias = np.empty((len(q), 2, 2)), np.empty((len(q), 2))
    M[:, 0, 0], M[:, 1, 1] = ZZ1R + ZZ2 + 2 * near, ZZ2
    M[:, 0, 1] = M[:, 1, 0] = ZZ2 + near
    bias[:, 0], bias[:, 1] = -across * v2 * (2 * v1 + v2), across * v1**2
    return M, bias


def level_axis(mass: float) -> Rigid:
    """A mass on a level axis: what `Chain` gives of the EMPS, much faster."""

    def rigid(q: Array, dq: Array) -> tuple[Array, Array]:
        return np.full((len(q), 1, 1), mass), np.zeros_like(q)

    return rigid


@dataclass(frozen=True, kw_only=True)
class Friction:
    """Friction along directions D (c, n), and what no description of the package knows of it.

    coulomb (c,), viscous (n, n), smooth (c,): v0 of tanh(v/v0). `asymmetry`: friction is 1 + a of
    it for v > 0 and 1 - a for v < 0. `stribeck`: at rest Coulomb friction is 1 + s of it, and falls
    to it as exp(-(v/(20 v0))²). root (c,): times sqrt(|v|) tanh(v/v0). load (n,): of the torque
    that the links take, whatever its sign; without rotors.
    """

    directions: Array
    coulomb: Array
    viscous: Array
    smooth: Array
    asymmetry: float = 0.0
    stribeck: float = 0.0
    root: Array | None = None
    load: Array | None = None

    def __call__(self, v: Array) -> Array:
        """Torques (S, n) at the speeds v (S, n)."""
        x = v.dot(self.directions.T) / self.smooth
        side, linear = np.tanh(x), v.dot(self.viscous)
        force = self.coulomb * side
        if self.stribeck:
            force = force * (1.0 + self.stribeck * np.exp(-((x / 20.0) ** 2)))
        if self.asymmetry:
            force, linear = (
                force * (1.0 + self.asymmetry * side),
                linear * (1.0 + self.asymmetry * np.sign(v)),
            )
        if self.root is not None:
            force = force + self.root * np.sqrt(np.abs(x) * self.smooth) * side
        return force.dot(self.directions) + linear

    def times(self, factor: float) -> "Friction":
        """Coulomb and viscous friction, larger by the factor."""
        return replace(self, coulomb=factor * self.coulomb, viscous=factor * self.viscous)

    def of_load(self, rigid: Array, v: Array) -> Array:
        """Torques (S, n) of friction by load where the links take `rigid` (S, n)."""
        return (
            np.zeros_like(rigid)
            if self.load is None
            else self.load * np.abs(rigid) * np.tanh(v / self.smooth[: v.shape[1]])
        )

    def left(self, torque: Array, v: Array) -> Array:
        """What the links take (S, n) of a torque (S, n): rigid + load |rigid| tanh(v/v0)
        = torque, load below 1.
        """
        return torque / (1.0 + self.load * np.sign(torque) * np.tanh(v / self.smooth[: v.shape[1]]))


@dataclass(frozen=True, kw_only=True, eq=False)  # a key by itself, not by its arrays
class Plant:
    """M(q) ddq + rigid bias + rotors + friction + offset + cogging = tau, and the arm's limits as
    robot.toml states them.

    cogging (n,): amplitude of a torque that is periodic in the joint's position, once a
    `pitch` (n,) in rad or m.
    """

    name: str
    rigid: Rigid
    rotor: Array
    friction: Friction
    offset: Array
    R: Array  # motor speed = R joint speed
    description: dict[str, Any] = field(repr=False)
    cogging: Array | None = None
    pitch: Array = field(default_factory=lambda: np.ones(1))

    @property
    def n(self) -> int:
        return len(self.offset)

    def inertia_and_bias(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """M (S, n, n) with the rotors, and the torques (S, n) of speed,
        gravity, offset and cogging.
        """
        M, bias = self.rigid(q, dq)
        if self.cogging is not None:
            bias = bias + self.cogging * np.sin(2 * np.pi * q / self.pitch)
        return M + self.rotor, bias + self.offset

    def inverse(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Torques (S, n) of the motion."""
        M, bias = self.inertia_and_bias(q, dq)
        rigid = (M @ ddq[..., None])[..., 0] + bias
        return rigid + self.friction(dq) + self.friction.of_load(rigid - self.offset, dq)


def plant(
    robot_toml: Path, *, smooth: float = 0.01, tilt_rad: float = 0.0, closed_form: bool = True
) -> Plant:
    """The plant that robot.toml describes by its `dh`, `motor_matrix` and `[parameters]`.

    smooth: v0 of friction in parts of the joint's speed limit. tilt_rad: the base is turned about
    x, unknown to whoever reads the description. closed_form: take the closed forms of SCARA and
    EMPS in place of the chain.
    """
    text = tomllib.loads(robot_toml.read_text())
    joints, values = text["joint"], text["parameters"]
    n = len(joints)

    def of_joint(name: str) -> Array:
        return np.array([values.get(f"{name}{j + 1}", 0.0) for j in range(n)])

    tensor = np.stack(
        [of_joint(x) for x in ("XX", "XY", "XZ", "XY", "YY", "YZ", "XZ", "YZ", "ZZ")], axis=-1
    )
    gravity = np.array([0.0, -9.81 * np.sin(tilt_rad), -9.81 * np.cos(tilt_rad)])
    dh = {
        key: np.array([joint["dh"][key] for joint in joints])
        for key in ("alpha_deg", "d_m", "theta_deg", "r_m")
    }
    chain = Chain(
        alpha=np.deg2rad(dh["alpha_deg"]),
        d=dh["d_m"],
        theta=np.deg2rad(dh["theta_deg"]),
        r=dh["r_m"],
        prismatic=np.array([joint["type"] == "prismatic" for joint in joints]),
        inertia=tensor.reshape(n, 3, 3),
        moment=np.stack([of_joint("MX"), of_joint("MY"), of_joint("MZ")], axis=-1),
        mass=of_joint("M"),
        gravity=gravity,
    )
    rotor, viscous, directions, coulomb = (
        np.diag(of_joint("Ia")),
        np.diag(of_joint("Fv")),
        np.eye(n),
        of_joint("Fc"),
    )
    R = np.array(text["motor_matrix"], dtype=float) if "motor_matrix" in text else np.eye(n)
    # motor 6 turns with joints 5 and 6; what it adds to joint 5 alone is in Ia5 and Fv5
    if text["name"] == "TX40":
        rotor[4, 5] = rotor[5, 4] = values["Ia6"]
        viscous[4, 5] = viscous[5, 4] = values["Fvm6"]
        directions = np.vstack([directions, [0, 0, 0, 0, 1, 1]])
        coulomb = np.append(coulomb, values["Fcm6"])
    speed = np.array(
        [j["speed_m_s"] if "speed_m_s" in j else np.deg2rad(j["speed_deg_s"]) for j in joints]
    )
    closed: dict[str, Rigid] = {"SCARA": scara, "EMPS": level_axis(float(chain.mass[0]))}
    return Plant(
        name=text["name"],
        rigid=closed.get(text["name"], chain) if closed_form and not tilt_rad else chain,
        rotor=rotor,
        friction=Friction(
            directions=directions,
            coulomb=coulomb,
            viscous=viscous,
            smooth=smooth * np.abs(directions) @ speed,
        ),
        offset=of_joint("Off"),
        R=R,
        description=text,
    )


def with_payload(body: Plant, mass: float, at: Sequence[float] = (0.0, 0.0, 0.0)) -> Plant:
    """The same arm with a point mass `at` (3,) in the frame of its last link, whose
    rigid bodies are a `Chain`.
    """
    chain, c = body.rigid, np.array(at)
    assert isinstance(chain, Chain)
    inertia, moment, masses = chain.inertia.copy(), chain.moment.copy(), chain.mass.copy()
    inertia[-1] += mass * (c @ c * np.eye(3) - np.outer(c, c))
    moment[-1] += mass * c
    masses[-1] += mass
    return replace(body, rigid=replace(chain, inertia=inertia, moment=moment, mass=masses))
