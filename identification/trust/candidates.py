"""Terms that the model may lack: as those that it has, they are asked for their
columns along a motion. A new one is an entry of `KINDS`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby, product

import numpy as np
from numpy.typing import NDArray

from acquisition.robot import Robot

from ..arrays import Array
from ..model import DirectModel, direct_model, inertia_unit, torque_of_links
from ..regression import MotionBlock, Problem, smooth

MIN_T = 5.0  # deviations, above chance
MIN_TAKEN_PERCENT = 2.0  # of the residual's square
# of a joint's peak speed: Stribeck friction has fallen to Coulomb friction about there
STRIBECK_SPEED_RATIO = 0.2
STRIBECK, ASYMMETRIC, SPRING = "Stribeck friction", "asymmetric friction", "spring"
TILT, LAG, ROTOR, ZERO, CLOCKS = "tilt of gravity", "lag", "rotor", "zero", "clock drift"
# Near reversals, friction that rises smoothly looks like these; they hardly show in the residual.
IN_FAST_ROWS = (LAG, CLOCKS)
# at which the torque of the links is computed: smooth, and low-passed to half a sample a row
SAMPLES_A_ROW = 4
SELECT_TERMS = "run `robot-identify friction`"


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis; `finding`: what is wrong, in a few words.
        unit, advice: unit of the coefficient; what to do.
        value, t: its coefficient, also in deviations.
        taken_percent: share of the residual's square that it explains; `together_percent`:
            all columns of its kind.
        moves: largest shift of an essential parameter, in half-widths.
        least_percent: of `taken_percent`, to be large.
        noticed: size of the coefficient that is noticed in nearly every recording; infinite in
            the span of the model.
    """

    kind: str
    where: str
    unit: str
    advice: str
    finding: str = ""
    value: float = 0.0
    t: float = 0.0
    taken_percent: float = 0.0
    together_percent: float = 0.0
    moves: float = 0.0
    least_percent: float = MIN_TAKEN_PERCENT
    noticed: float = np.inf

    @property
    def found(self) -> bool:
        """Whether it is significant and large."""
        large = self.kind != LAG and self.taken_percent > self.least_percent
        return abs(self.t) > MIN_T and (large or (self.moves > 1 and self.kind in IN_FAST_ROWS))


Places = Callable[["Candidates"], Iterable[tuple[str, int]]]
# (N, n) per unit of a candidate along a motion, by what `_of_links` gives there, of its k-th place
Torque = Callable[["Candidates", MotionBlock, Array, int], Array]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A kind of term, at one place or several: at joints, axes, or directions of friction.

    Attributes:
        name, torque: terms of one joint each share a column, unless they act `everywhere`.
        told: unit and advice at a joint.
        friction: the term of a joint's description that is this one.
        at: its places, each its name and the joint that tells it.
        lacks: whether a model without that may lack it at its k-th place.
        missing: of `finding`, its end.
        least_percent: as of `MissingTerm`, where no link weighs.
    """

    name: str
    torque: Torque
    told: Callable[[Robot, int], tuple[str, str]]
    everywhere: bool = False
    friction: str = ""
    lacks: Callable[["Candidates", int], bool] = lambda *_: True
    at: Places = lambda of: [
        (f"of joint {joint.name}", j) for j, joint in enumerate(of.robot.joints)
    ]
    missing: str = " missing"
    least_percent: float = MIN_TAKEN_PERCENT


@dataclass(frozen=True, kw_only=True, eq=False)
class Candidates:
    """Terms that are not in the model of a recording, asked for their columns along any motion.

    Attributes:
        problem: of the recording; `beta`: (b,) its base parameters, about which the columns are.
        peak, sliding: (n,) and (c,) largest speeds of the joints, and along the
            directions of Coulomb friction.
        simulated: whether the motion has the torque of a simulated robot that
            follows a recorded reference.
        gains: whether drive gains are identified.
    """

    problem: Problem
    beta: Array
    peak: Array
    sliding: Array
    simulated: bool
    gains: bool

    @cached_property
    def terms(self) -> tuple[MissingTerm, ...]:
        """The terms."""
        robot, at_zero = self.robot, _of_links(self._links, *np.zeros((3, 1, len(self.peak))))
        weighs = robot.n > 1 and np.abs(at_zero).max() > 1e-9
        return tuple(
            MissingTerm(
                kind=kind.name,
                where=where,
                unit=unit,
                advice=advice,
                finding=f"{kind.name} {where}{kind.missing}",
                least_percent=MIN_TAKEN_PERCENT if weighs else kind.least_percent,
            )
            for kind, where, j in [(KINDS[i], where, j) for i, _, where, j in self._lacking]
            for unit, advice in [kind.told(robot, j)]
        )

    @cached_property
    def places(self) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """By term its column (k,) and the joints (k, n) whose rows in it are its own."""
        each = [(i, k * KINDS[i].everywhere) for i, k, _, _ in self._lacking]
        columns, one = list(dict.fromkeys(each)), np.eye(len(self.peak), dtype=bool)
        acts = [one[j] | KINDS[i].everywhere for i, _, _, j in self._lacking]
        return np.array([columns.index(key) for key in each], dtype=np.intp), np.array(acts)

    @cached_property
    def weighs(self) -> NDArray[np.intp]:
        """(g,) places of the base parameters of links that weigh."""
        idm, columns = self.problem.model, self.problem.base.columns
        q = np.sin(np.outer(np.arange(1, 6), np.arange(1, idm.robot.n + 1)))  # some poses
        still = idm.regressor(q, 0 * q, 0 * q)[:, :, columns] * idm.of_links[columns]
        return np.flatnonzero(np.abs(still).max(axis=(0, 1)) > 1e-12 * np.abs(still).max())

    def at_rest(self, motion: MotionBlock) -> Array:
        """(n, g, rows) the torques of `weighs` at rest, which change slowly, weighted and decimated
        along the measured motion.
        """
        q, columns = motion.kept(motion.q), motion.problem.base.columns[self.weighs]
        still = motion.problem.model.regressor(q, 0 * q, 0 * q)[:, :, columns]
        return motion.filtered(motion.weights)[:, None] * still.transpose(1, 2, 0)

    def columns(self, motion: MotionBlock) -> Array:
        """(n, k, rows) torque per unit of the terms, weighted and decimated, along a motion with
        the torque that `beta` predicts.
        """
        places, acts = self.places
        found = np.zeros((len(self.peak), int(places.max()) + 1, len(motion.share.T)))
        links = smooth(partial(_of_links, self._links), motion, _stride(motion))
        for place, (i, k, _, _) in dict(zip(places, self._lacking, strict=True)).items():
            torque = KINDS[i].torque(self, motion, links, k)
            at = np.flatnonzero(acts[places == place].any(axis=0) & torque.any(axis=0))
            if len(at):
                found[at, place] = motion.weighted(torque.T[at], at)
        return found

    @cached_property
    def _lacking(self) -> list[tuple[int, int, str, int]]:
        """Each term: the number of its kind, its place and the name of that, and the joint that
        tells it.
        """
        known, numbers = [joint.terms for joint in self.robot.joints], range(len(KINDS))
        return [
            (i, k, where, j)
            for at, kinds in groupby(numbers, lambda i: KINDS[i].at)
            for (k, (where, j)), i in product(enumerate(at(self)), kinds)
            if KINDS[i].friction not in known[j] and KINDS[i].lacks(self, k)
        ]

    @property
    def robot(self) -> Robot:
        """Its robot."""
        return self.problem.signals.robot

    @property
    def _span_s(self) -> Array:
        """Instants of the first and the last sample used."""
        settings = self.problem.settings
        return np.array([settings.start, settings.stop - 1]) / self.problem.signals.sample_rate_hz

    @cached_property
    def _chi(self) -> Array:
        """(p,) standard parameters, of those that are regrouped only what they are regrouped in."""
        chi = np.zeros(self.problem.model.p)
        chi[self.problem.base.columns] = self.beta
        return chi

    @cached_property
    def _links(self) -> DirectModel:
        idm = self.problem.model
        return direct_model(idm, np.where(idm.of_links, self._chi, 0.0))

    def _friction(self, name: str) -> Array:
        """(n,) a hundredth of the friction of each joint by this name, Fc or Fv."""
        value = dict(zip(self.problem.model.names, 0.01 * self._chi, strict=True))
        return np.array([value.get(f"{name}{j + 1}", 0.0) for j in range(len(self.peak))])


def _of_links(links: DirectModel, q: Array, dq: Array, ddq: Array) -> Array:
    """The links' torque along a motion, and its derivatives by the positions: (N, n, 1 + n)."""
    tau, slopes = torque_of_links(links, (q, dq, ddq))
    return np.concatenate([tau[..., None], slopes[0]], axis=2)


def _stride(motion: MotionBlock) -> int:
    """Step between samples that tell what links need."""
    return motion.decimation.factor // SAMPLES_A_ROW


def _listed(term: str, keys: str, unit: str = "") -> Callable[[Robot, int], tuple[str, str]]:
    """What is told of a friction term that a description has in a list, or by keys."""
    return lambda robot, j: (
        unit or robot.effort_units[j],
        f'add "{term}" to its friction'
        if isinstance(robot.joints[j].friction, tuple)
        else f"describe it as {keys}",
    )


def _per_angle(robot: Robot, j: int) -> tuple[str, float]:
    """The unit of a zero, and its size."""
    return ("deg", np.pi / 180) if robot.joints[j].type == "revolute" else ("mm", 1e-3)


def _directions(of: Candidates) -> list[tuple[str, int]]:
    """Of Coulomb friction: of a joint, or of the motor of the last joint that it moves."""
    names = [joint.name for joint in of.robot.joints]
    return [
        (f"of{' the motor of' if len(at) > 1 else ''} joint {names[at[-1]]}", int(at[-1]))
        for at in map(np.flatnonzero, of.problem.model.coulomb_directions)
    ]


def _turned(of: Candidates, k: int) -> Array:
    """Gravity (3,) per rad of a rotation about an axis of the base."""
    return np.cross(np.eye(3)[k], np.array(of.robot.gravity))


def _root(of: Candidates, x: MotionBlock, links: Array, k: int) -> Array:
    along = of.problem.model.coulomb_directions[k]
    v = x.dq @ along
    return np.asarray((np.sign(v) * np.sqrt(np.abs(v)))[:, None] * along)


# Those at the same places are tried place by place.
KINDS = (
    Kind(
        name=ASYMMETRIC,
        torque=lambda of, x, *_: of._friction("Fc") + of._friction("Fv") * np.abs(x.dq),
        told=_listed("asymmetric", 'friction = "asymmetric", which includes an offset', "% of it"),
        friction="asymmetric",
        lacks=lambda of, k: (
            not (joint := of.robot.joints[k]).one_sided
            and not {"viscous", "coulomb"}.isdisjoint(joint.terms)
        ),
    ),
    Kind(
        name="offset",
        torque=lambda of, x, *_: np.ones_like(x.q),
        told=_listed("offset", "offset = true"),
        friction="offset",
    ),
    Kind(
        name="drift",
        torque=lambda of, x, *_: ((x.t_s - of._span_s[0]) / np.ptp(of._span_s))[:, None] + 0 * x.q,
        told=lambda robot, j: (
            f"{robot.effort_units[j]} over the recording",
            "warm the robot up, or record a shorter motion",
        ),
        missing="",
    ),
    Kind(
        name=SPRING,
        torque=lambda of, x, *_: x.q,
        told=lambda robot, j: (
            f"{robot.effort_units[j]}/{robot.joints[j].position_unit}",
            "record its torque (of a spring, a hose or a weight) as known_torque",
        ),
        least_percent=10.0,  # any slow error correlates with a slow position
    ),
    Kind(
        name=STRIBECK,
        torque=lambda of, x, *_: (
            np.sign(x.dq)
            * np.exp(-((x.dq / (STRIBECK_SPEED_RATIO * np.maximum(of.peak, 1e-300))) ** 2))
        ),
        told=lambda robot, j: (
            robot.effort_units[j],
            "leave out slow samples by a larger low_speed_percent of [identification]",
        ),
        friction="stribeck",
    ),
    Kind(
        name=ZERO,
        torque=lambda of, x, links, k: _per_angle(of.robot, k)[1] * links[..., 1 + k],
        told=lambda robot, j: (
            _per_angle(robot, j)[0],
            "check the zero of its position (home offset 607Ch, zero_deg or zero_m)",
        ),
        everywhere=True,
        missing="",
    ),
    Kind(
        name=ROTOR,
        torque=lambda of, x, *_: x.ddq,
        told=lambda robot, j: (inertia_unit(robot, j), "rotor_inertia = true"),
        lacks=lambda of, k: not of.robot.joints[k].rotor_inertia,
    ),
    Kind(
        name="load friction",
        torque=lambda of, x, links, _: np.abs(links[..., 0]) * np.sign(x.dq),
        told=lambda *_: ("", SELECT_TERMS),
        friction="load",
    ),
    Kind(
        at=lambda of: ((f"about {axis}", 0) for axis in "xyz"),
        name=TILT,
        torque=lambda of, x, _, k: smooth(
            lambda q, *_: of._links.gravity(q, _turned(of, k)), x, _stride(x)
        ),
        told=lambda *_: ("rad", "level the base, or set gravity_m_s2"),
        everywhere=True,
        lacks=lambda of, k: bool(_turned(of, k).any()),
        missing="",
    ),
    Kind(
        at=_directions,
        name="root friction",
        torque=_root,
        told=lambda robot, j: (
            f"{robot.effort_units[j]} ({robot.joints[j].position_unit}/s)^-½",
            SELECT_TERMS,
        ),
        everywhere=True,
        friction="root",
    ),
    Kind(
        at=lambda of: [("between positions and efforts", 0)],
        name=CLOCKS,
        torque=lambda of, x, *_: -0.01 * (x.t_s - of._span_s.mean())[:, None] * x.rate(x.tau),
        told=lambda *_: ("%", "stamp positions and efforts by one clock"),
        everywhere=True,
        missing="",
    ),
    Kind(
        name=LAG,
        torque=lambda of, x, *_: -1e-3 * x.rate(x.tau),
        told=lambda *_: ("ms", "check how its effort is filtered and stamped"),
        lacks=lambda of, k: of.simulated and len(of.peak) > 1,
        missing="",
    ),
    Kind(  # the coefficient of a predicted torque is the gain relative to others, less 1
        name="relative gain",
        torque=lambda of, x, *_: 0.01 * x.tau,
        told=lambda *_: (
            "%",
            "check its drive_gain and ratio against those of the other joints",
        ),
        lacks=lambda of, k: of.robot.gain_known and not of.gains and len(of.peak) > 1,
    ),
)
