"""Kinds of terms that a model may lack, and the model about an estimate that makes them.

Each kind has its torque along a motion, what to do about it, and where it is looked for. The model
is that of a recording. A new kind is an entry of `KINDS`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Ints
from ..model import DirectModel, base_prior, direct_model
from ..regression import MotionBlock, Problem, row_blocks, smooth

MIN_ARM_M = 1e-9  # of a weight about an axis
# Hysteresis changes sides within these shares of a joint's travel; hoses and cables lie between
# them.
TRAVELS = (0.1, 0.2)
FORGOTTEN = 1e-12  # share of z that is left after the way since
MIN_TAKEN_PERCENT = 2.0  # of the residual's square
# Stribeck friction has fallen to Coulomb friction at about this share of the peak speed.
STRIBECK_SPEED_RATIO = 0.2
STRIBECK, ASYMMETRIC, SPRING = "Stribeck friction", "asymmetric friction", "spring"
CURVED = "spring that is not linear"
LIMITED = 0.7  # of a joint's largest torque
TILT, LAG, ROTOR, ZERO, CLOCKS = "base tilt", "delay", "rotor", "zero", "clock drift"
RATIO, HYSTERESIS, IN_PARTS = "ratio", "hysteresis", "friction of a part of the time"
PARTS = 6  # of the time
POSITIVE = (STRIBECK, ROTOR, HYSTERESIS)  # their values
# Near reversals, friction that rises smoothly looks like these.
IN_FAST_ROWS = (LAG, CLOCKS)
# The torque of the links is smooth and low-passed, so a few samples per row suffice.
SAMPLES_A_ROW = 4
SELECT_TERMS = "Run `robot-identify friction`"


@dataclass(frozen=True, kw_only=True, eq=False)
class About:
    """The model of a recording, linearised at values of its parameters, from which terms are made.

    Attributes:
        problem: the recording's problem.
        beta: (b,) its base parameters.
        peak, most: (n,) largest speeds and torques of the joints in all recordings.
        speed: (T, n) measured speed in the rows of this recording.
        alone: True if there is no other recording.
        simulated: True if the motion is that of a simulated robot that follows a recorded
            reference.
    """

    problem: Problem
    beta: Array
    peak: Array
    most: Array
    speed: Array
    alone: bool
    simulated: bool

    @cached_property
    def weighs(self) -> Ints:
        """Indices of the base parameters of links that weigh, (g,)."""
        idm, columns = self.problem.model, self.problem.base.columns
        q = np.sin(np.outer(np.arange(1, 6), np.arange(1, idm.robot.n + 1)))  # some poses
        arms = np.abs(idm.regressor(q, 0 * q, 0 * q)[:, :, columns] * idm.of_links[columns])
        return np.flatnonzero(arms.max(axis=(0, 1)) > MIN_ARM_M * np.linalg.norm(idm.robot.gravity))

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for other processes.

        It has the hysteresis where blocks begin, without the speeds of all rows.
        """
        return vars(self) | {"wound": self.wound, "speed": self.speed[:0]}

    @cached_property
    def travels(self) -> Array:
        """Shares of each joint's travel, (k, n)."""
        return np.maximum(np.outer(TRAVELS, np.ptp(self.problem.poses, axis=0)), 1e-9)

    @cached_property
    def wound(self) -> dict[int, Array]:
        """Hysteresis z (k, n) where a block begins, by its first row: that of the row before."""
        row_s = self.problem.settings.decimation / self.problem.signals.sample_rate_hz
        ways = row_s * np.concatenate([0 * self.travels[:1], self.speed])
        z = np.stack([dahl(ways / travel, ways[0]) for travel in self.travels])
        return {near.start: z[:, near.start] for near, _ in row_blocks(self.problem)}

    @cached_property
    def prior(self) -> tuple[dict[str, float], str]:
        """A priori base parameters of links, by name, and their source."""
        return base_prior(self.problem.model, self.problem.base)

    @property
    def robot(self) -> Robot:
        """The recording's robot."""
        return self.problem.signals.robot

    @property
    def span_s(self) -> Array:
        """Instants of the first and the last sample used."""
        settings = self.problem.settings
        return np.array([settings.start, settings.stop - 1]) / self.problem.signals.sample_rate_hz

    @cached_property
    def links(self) -> DirectModel:
        """The links, without parameters that are regrouped."""
        idm, chi = self.problem.model, np.zeros(self.problem.model.p)
        chi[self.problem.base.columns] = self.beta
        return direct_model(idm, np.where(idm.of_links, chi, 0.0))

    def friction(self, name: str) -> Array:
        """Return a hundredth of the friction of each joint (n,) by this name, Fc or Fv."""
        names = (self.problem.model.names[c] for c in self.problem.base.columns)
        value = dict(zip(names, 0.01 * self.beta, strict=True))
        return np.array([value.get(f"{name}{j + 1}", 0.0) for j in range(len(self.peak))])


def dahl(steps: Array, begin: Array) -> Array:
    """Return z (N, n) of dz = (dq - |dq| z) / x from its first value on, by the steps dq / x.

    Each step is z <- a z + b; steps are combined in pairs, then in fours, and so on.
    """
    a, reach = np.exp(-np.abs(steps)), 1
    z = np.asarray(np.sign(steps) * (1 - a))
    z[0] = begin
    while reach < len(z) and a[reach:].max() > FORGOTTEN:
        z[reach:] += a[reach:] * z[:-reach]
        a[reach:] *= a[:-reach].copy()
        reach *= 2
    return z


# A torque is (N, n) per unit of the candidate at its k-th place along a motion; the third argument
# is the result of `_of_links` there.
Torque = Callable[[About, MotionBlock, Array, int], Array]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of term, at one place or several: at joints, axes, or directions of friction.

    Attributes:
        name, torque: terms of one joint each share a column, unless they act `everywhere`. `torque`
            is None for those that are torques `of` the model, by the beginnings of their
            parameters' names, times a function `in_time` of the time (S,), from -1/2 to 1/2, and of
            the place.
        parts: columns of each joint, in sequence at its places.
        unit: unit of the coefficient, by those of the joint.
        advice: what to do; where friction is a list in which it may be `listed`, to add it.
        friction: the friction term in the description of a joint that equals this one.
        at: its places, each with its name and its joint.
        lacks: tests whether a model without the term may lack it at its k-th place.
        missing: the end of `finding`.
        least_percent: as in `MissingTerm`.
    """

    name: str
    unit: str
    advice: str
    torque: Torque | None = None
    of: tuple[str, ...] = ()
    in_time: Callable[[Array, int], Array] = lambda u, _: u
    listed: bool = False
    everywhere: bool = False
    parts: int = 1
    friction: str = ""
    lacks: Callable[[About, int], bool] = lambda *_: True
    at: Callable[[About], Iterable[tuple[str, int]]] = lambda of: [
        (f"of joint {joint.name}", j) for j, joint in enumerate(of.robot.joints)
    ]
    missing: str = " missing"
    least_percent: Callable[[About], float] = lambda _: MIN_TAKEN_PERCENT


def stride_of(motion: MotionBlock) -> int:
    """Return the step between samples that suffices for the links."""
    return max(1, motion.decimation.factor // SAMPLES_A_ROW)


def _directions(of: About) -> list[tuple[str, int]]:
    """Return the directions of Coulomb friction.

    A direction is that of a joint, or of the motor of the last joint that the motor moves.
    """
    return [
        (f"of{' the motor of' * (len(at) > 1)} joint {of.robot.joints[at[-1]].name}", int(at[-1]))
        for at in map(np.flatnonzero, of.problem.model.coulomb_directions)
    ]


def _turned(of: About, k: int) -> Array:
    """Return the change of gravity (3,) per rad of rotation about an axis of the base."""
    return np.cross(np.eye(3)[k], np.array(of.robot.gravity))


def _root(of: About, x: MotionBlock, links: Array, k: int) -> Array:
    v = x.dq @ (along := of.problem.model.coulomb_directions[k])
    return np.asarray((np.sign(v) * np.sqrt(np.abs(v)))[:, None] * along)


def _with_ratio(of: About, x: MotionBlock, links: Array, k: int) -> Array:
    """Return the torque of joint k with a ratio that is wrong by one percent.

    The ratio is wrong in motion and in motor torque.
    """
    torque = np.array(links[..., 1 + len(of.peak) + k])
    torque[:, k] += x.tau[:, k]
    return np.asarray(0.01 * torque)


def _of_parts(of: About) -> list[tuple[str, int]]:
    """Return each joint in each part of the time; the parts of several recordings coincide."""
    first, last = of.span_s if of.alone else (0.0, 100.0)
    borders = np.linspace(first, last, PARTS + 1)
    unit = "s" if of.alone else "% of each recording"
    times = [f"from {a:.3g} to {b:.3g} {unit}" for a, b in pairwise(borders)]
    return [(f"{where} {time}", j) for where, j in Kind.at(of) for time in times]


def _of_springs(of: About) -> float:
    """Return the least share of the residual for springs.

    Any slow error resembles a slow position. The share is therefore larger for a single joint and
    for a robot whose links do not weigh.
    """
    return MIN_TAKEN_PERCENT if of.robot.n > 1 and len(of.weighs) else 10.0


def _hysteresis(of: About, x: MotionBlock, _: Array, k: int) -> Array:
    """Return z (N, n) of Dahl friction, with x a share of each joint's travel."""
    travel, begin = (every[k % len(TRAVELS)] for every in (of.travels, of.wound[x.near.start]))
    return dahl(np.diff(x.q, axis=0, prepend=x.q[:1]) / travel, begin)


KINDS = (
    Kind(
        name=ASYMMETRIC,
        torque=lambda of, x, *_: of.friction("Fc") + of.friction("Fv") * np.abs(x.dq),
        unit="% of the friction",
        advice='Describe it as friction = "asymmetric", which includes an offset',
        listed=True,
        friction="asymmetric",
        lacks=lambda of, k: (
            not (joint := of.robot.joints[k]).one_sided
            and not {"viscous", "coulomb"}.isdisjoint(joint.terms)
        ),
    ),
    Kind(
        name="offset",
        torque=lambda of, x, *_: np.ones_like(x.q),
        unit="{effort}",
        advice="Describe it as offset = true",
        listed=True,
        friction="offset",
    ),
    Kind(
        name="drift",
        torque=lambda of, x, *_: ((x.t_s - of.span_s[0]) / np.ptp(of.span_s))[:, None] + 0 * x.q,
        unit="{effort} over the recording",
        advice="Warm the robot up, or record a shorter motion",
        missing="",
    ),
    Kind(
        name=SPRING,
        torque=lambda of, x, *_: x.q,
        unit="{effort}/{position}",
        advice="Record its torque (of a spring, a hose or a weight) as known_torque",
        least_percent=_of_springs,
    ),
    Kind(
        name=CURVED,
        torque=lambda of, x, *_: (
            (off := x.q - of.problem.poses.mean(axis=0))
            * (off / np.maximum(np.ptp(of.problem.poses, axis=0), 1e-9)) ** 2
        ),
        unit="{effort}/{position}",
        advice="Record its torque (of a spring, a hose or a stop) as known_torque",
        least_percent=_of_springs,
    ),
    Kind(
        name="limit of the effort",
        torque=lambda of, x, *_: np.sign(x.tau) * np.maximum(np.abs(x.tau) - LIMITED * of.most, 0),
        unit="of what is beyond 70 % of its peak",
        advice="Set saturation of the motor, or record the effort behind its limit",
        missing="",
    ),
    Kind(
        name=STRIBECK,
        torque=lambda of, x, *_: (
            np.sign(x.dq)
            * np.exp(-((x.dq / (STRIBECK_SPEED_RATIO * np.maximum(of.peak, 1e-300))) ** 2))
        ),
        unit="{effort}",
        advice="Leave out slow samples by a larger low_speed_percent of [identification]",
        friction="stribeck",
    ),
    Kind(
        name=ZERO,
        torque=lambda of, x, links, k: (
            links[..., 1 + k] * (np.pi / 180 if of.robot.joints[k].type == "revolute" else 1e-3)
        ),
        unit="{zero}",
        advice="Check the zero of its position (home offset 607Ch, zero_deg or zero_m)",
        everywhere=True,
        missing="",
    ),
    Kind(
        name=ROTOR,
        torque=lambda of, x, *_: x.ddq,
        unit="{inertia}",
        advice="Set rotor_inertia = true",
        lacks=lambda of, k: not of.robot.joints[k].rotor_inertia,
    ),
    Kind(
        name="load-dependent friction",
        torque=lambda of, x, links, _: np.abs(links[..., 0]) * np.sign(x.dq),
        unit="",
        advice=SELECT_TERMS,
        friction="load",
    ),
    Kind(
        name=TILT,
        at=lambda of: ((f"about {axis}", 0) for axis in "xyz"),
        torque=lambda of, x, _, k: smooth(
            lambda q, *_: of.links.gravity(q, _turned(of, k)), x, stride_of(x)
        ),
        unit="rad",
        advice="Level the base, or set gravity_m_s2",
        everywhere=True,
        lacks=lambda of, k: bool(_turned(of, k).any()),
        missing="",
    ),
    Kind(
        name="square-root friction",
        at=_directions,
        torque=_root,
        unit="{effort} ({position}/s)^-½",
        advice=SELECT_TERMS,
        everywhere=True,
        friction="root",
    ),
    Kind(
        name=CLOCKS,
        at=lambda of: [("between positions and efforts", 0)],
        torque=lambda of, x, *_: -0.01 * (x.t_s - of.span_s.mean())[:, None] * x.rate(x.tau),
        unit="%",
        advice="Timestamp positions and efforts by one clock",
        everywhere=True,
        missing="",
    ),
    Kind(
        name=LAG,
        torque=lambda of, x, *_: -1e-3 * x.rate(x.tau),
        unit="ms",
        advice="Check how its effort is filtered and timestamped",
        lacks=lambda of, k: of.simulated and len(of.peak) > 1,
        missing="",
    ),
    Kind(
        name=RATIO,
        torque=_with_ratio,
        unit="%",
        advice="Check its ratio",
        everywhere=True,
        lacks=lambda of, k: of.robot.n > 1,
        missing=" off",
    ),
    Kind(
        name="drift of the torque constant",
        of=("",),
        in_time=lambda u, _: 0.01 * u,
        unit="% over the recording",
        advice="Warm the drives up, or record a shorter motion",
        missing="",
    ),
    Kind(
        name="drift of friction",
        of=("Fv", "Fc"),
        in_time=lambda u, _: 0.01 * u,
        unit="% over the recording",
        advice="Warm the robot up, or record a shorter motion",
        missing="",
    ),
    Kind(
        name=HYSTERESIS,
        at=lambda of: [place for place in Kind.at(of) for _ in TRAVELS],
        torque=_hysteresis,
        unit="{effort}",
        advice="Look for a hose or a cable that follows the joint with friction of its own",
        parts=len(TRAVELS),
        missing="",
    ),
    Kind(
        name=IN_PARTS,
        at=_of_parts,
        of=("Fc",),
        in_time=lambda u, k: 0.01 * (np.floor(PARTS * (u + 0.5)) == k % PARTS),
        unit="% of the friction",
        advice="Look for a brake or a cable that drags then, or leave that time out",
        least_percent=lambda _: 10.0,  # of as many tries, some t are large by chance
        lacks=lambda of, k: "coulomb" in of.robot.joints[k // PARTS].terms,
        missing="",
    ),
    # The coefficient of a predicted torque is the gain relative to the other joints, minus 1.
    Kind(
        name="relative gain",
        torque=lambda of, x, *_: 0.01 * x.tau,
        unit="%",
        advice="Check its drive_gain and ratio against those of the other joints",
        lacks=lambda of, k: (
            of.robot.gain_known and of.robot.identified_gain is None and of.robot.n > 1
        ),
    ),
)
