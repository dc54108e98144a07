"""Terms that the model may lack: as those that it has, they are asked for their
columns along a motion. A new one is an entry of `KINDS`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

from acquisition.robot import Robot

from ..arrays import Array, Ints
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
MIN_ARM_M = 1e-9  # of a weight about an axis
# at which the torque of the links is computed: smooth, and low-passed to half a sample a row
SAMPLES_A_ROW = 4
SELECT_TERMS = "run `robot-identify friction`"


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A term that the model may lack.

    Attributes:
        kind, where: the term, and its joint or axis; `finding`: what is wrong, in a few words.
        place: the number of its kind, and its place of that; `column`: of C; `joint`: whose rows in
            that are its own, None for all.
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
    place: tuple[int, int] = (0, 0)
    column: int = 0
    joint: int | None = None
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
        unit: of the coefficient, by those of the joint that tells it.
        advice: what to do; where friction is a list in which it may be `listed`, to add it.
        friction: the term of a joint's description that is this one.
        at: its places, each its name and the joint that tells it.
        lacks: whether a model without that may lack it at its k-th place.
        missing: of `finding`, its end.
        least_percent: as of `MissingTerm`, where no link weighs.
    """

    name: str
    torque: Torque
    unit: str
    advice: str
    listed: bool = False
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
    """

    problem: Problem
    beta: Array
    peak: Array
    sliding: Array
    simulated: bool

    @cached_property
    def terms(self) -> tuple[MissingTerm, ...]:
        """The terms."""
        robot, found, columns = self.robot, list[MissingTerm](), dict[tuple[int, int], int]()
        weighs = robot.n > 1 and len(self.weighs)
        for i, kind in enumerate(KINDS):
            for k, (where, j) in enumerate(kind.at(self)):
                if kind.friction in robot.joints[j].terms or not kind.lacks(self, k):
                    continue
                listed = kind.listed and isinstance(robot.joints[j].friction, tuple)
                term = MissingTerm(
                    kind=kind.name,
                    where=where,
                    unit=kind.unit.format(**_units(robot, j)),
                    advice=f'add "{kind.friction}" to its friction' if listed else kind.advice,
                    finding=f"{kind.name} {where}{kind.missing}",
                    place=(i, k),
                    column=columns.setdefault((i, k * kind.everywhere), len(columns)),
                    joint=None if kind.everywhere else j,
                    least_percent=MIN_TAKEN_PERCENT if weighs else kind.least_percent,
                )
                found.append(term)
        return tuple(found)

    @cached_property
    def weighs(self) -> Ints:
        """(g,) places of the base parameters of links that weigh."""
        idm, columns = self.problem.model, self.problem.base.columns
        q = np.sin(np.outer(np.arange(1, 6), np.arange(1, idm.robot.n + 1)))  # some poses
        still = np.abs(idm.regressor(q, 0 * q, 0 * q)[:, :, columns] * idm.of_links[columns])
        return np.flatnonzero(
            still.max(axis=(0, 1)) > MIN_ARM_M * np.linalg.norm(self.robot.gravity)
        )

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
        of_columns = {term.column: term for term in self.terms}
        found = np.zeros((len(self.peak), len(of_columns), len(motion.share.T)))
        links = smooth(partial(_of_links, self._links), motion, _stride(motion))
        for column, term in of_columns.items():
            i, k = term.place
            torque = KINDS[i].torque(self, motion, links, k)
            if len(at := np.flatnonzero(torque.any(axis=0))):
                found[at, column] = motion.weighted(torque.T[at], at)
        return found

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
    def _links(self) -> DirectModel:
        """The links, with nothing of parameters that are regrouped."""
        idm, chi = self.problem.model, np.zeros(self.problem.model.p)
        chi[self.problem.base.columns] = self.beta
        return direct_model(idm, np.where(idm.of_links, chi, 0.0))

    def _friction(self, name: str) -> Array:
        """(n,) a hundredth of the friction of each joint by this name, Fc or Fv."""
        names = (self.problem.model.names[c] for c in self.problem.base.columns)
        value = dict(zip(names, 0.01 * self.beta, strict=True))
        return np.array([value.get(f"{name}{j + 1}", 0.0) for j in range(len(self.peak))])


def _of_links(links: DirectModel, q: Array, dq: Array, ddq: Array) -> Array:
    """The links' torque along a motion, and its derivatives by the positions: (N, n, 1 + n)."""
    tau, slopes = torque_of_links(links, (q, dq, ddq))
    return np.concatenate([tau[..., None], slopes[0]], axis=2)


def _stride(motion: MotionBlock) -> int:
    """Step between samples that tell what links need."""
    return motion.decimation.factor // SAMPLES_A_ROW


def _units(robot: Robot, j: int) -> dict[str, str]:
    """The units of a joint."""
    turns = robot.joints[j].type == "revolute"
    return {
        "effort": robot.effort_units[j],
        "position": robot.joints[j].position_unit,
        "zero": "deg" if turns else "mm",
        "inertia": inertia_unit(robot, j),
    }


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


KINDS = (
    Kind(
        name=ASYMMETRIC,
        torque=lambda of, x, *_: of._friction("Fc") + of._friction("Fv") * np.abs(x.dq),
        unit="% of it",
        advice='describe it as friction = "asymmetric", which includes an offset',
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
        advice="describe it as offset = true",
        listed=True,
        friction="offset",
    ),
    Kind(
        name="drift",
        torque=lambda of, x, *_: ((x.t_s - of._span_s[0]) / np.ptp(of._span_s))[:, None] + 0 * x.q,
        unit="{effort} over the recording",
        advice="warm the robot up, or record a shorter motion",
        missing="",
    ),
    Kind(
        name=SPRING,
        torque=lambda of, x, *_: x.q,
        unit="{effort}/{position}",
        advice="record its torque (of a spring, a hose or a weight) as known_torque",
        least_percent=10.0,  # any slow error correlates with a slow position
    ),
    Kind(
        name=STRIBECK,
        torque=lambda of, x, *_: (
            np.sign(x.dq)
            * np.exp(-((x.dq / (STRIBECK_SPEED_RATIO * np.maximum(of.peak, 1e-300))) ** 2))
        ),
        unit="{effort}",
        advice="leave out slow samples by a larger low_speed_percent of [identification]",
        friction="stribeck",
    ),
    Kind(
        name=ZERO,
        torque=lambda of, x, links, k: (
            links[..., 1 + k] * (np.pi / 180 if of.robot.joints[k].type == "revolute" else 1e-3)
        ),
        unit="{zero}",
        advice="check the zero of its position (home offset 607Ch, zero_deg or zero_m)",
        everywhere=True,
        missing="",
    ),
    Kind(
        name=ROTOR,
        torque=lambda of, x, *_: x.ddq,
        unit="{inertia}",
        advice="rotor_inertia = true",
        lacks=lambda of, k: not of.robot.joints[k].rotor_inertia,
    ),
    Kind(
        name="load friction",
        torque=lambda of, x, links, _: np.abs(links[..., 0]) * np.sign(x.dq),
        unit="",
        advice=SELECT_TERMS,
        friction="load",
    ),
    Kind(
        name=TILT,
        at=lambda of: ((f"about {axis}", 0) for axis in "xyz"),
        torque=lambda of, x, _, k: smooth(
            lambda q, *_: of._links.gravity(q, _turned(of, k)), x, _stride(x)
        ),
        unit="rad",
        advice="level the base, or set gravity_m_s2",
        everywhere=True,
        lacks=lambda of, k: bool(_turned(of, k).any()),
        missing="",
    ),
    Kind(
        name="root friction",
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
        torque=lambda of, x, *_: -0.01 * (x.t_s - of._span_s.mean())[:, None] * x.rate(x.tau),
        unit="%",
        advice="stamp positions and efforts by one clock",
        everywhere=True,
        missing="",
    ),
    Kind(
        name=LAG,
        torque=lambda of, x, *_: -1e-3 * x.rate(x.tau),
        unit="ms",
        advice="check how its effort is filtered and stamped",
        lacks=lambda of, k: of.simulated and len(of.peak) > 1,
        missing="",
    ),
    # the coefficient of a predicted torque is the gain relative to others, less 1
    Kind(
        name="relative gain",
        torque=lambda of, x, *_: 0.01 * x.tau,
        unit="%",
        advice="check its drive_gain and ratio against those of the other joints",
        lacks=lambda of, k: (
            of.robot.gain_known and of.robot.identified_gain is None and of.robot.n > 1
        ),
    ),
)
