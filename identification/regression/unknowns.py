"""The unknowns x of a fit, and the base parameters of each recording in them.

    beta_k = P_k x + known_k

P_k and known_k are constant. A shared base parameter, or one of recording k alone, is a unit column
of P_k; the free part of a payload K_n phi are further columns, its known part is in known_k. x has,
in this order:

    Fv1, Off1@A, Off1@B, ZZ2 ...    base parameters as in the model, those of one recording each in
                                    the order of the recordings, in the place of the common one
    MX:loaded ...                   what is estimated of each payload
    K:motor_1 ...                   gains of drives, as factors on the described ones
    K:motor_2, half-width 0:0 ...   what is given with a half-width
    lag 0 ...                       the delay of each group of recordings

Rows determine all up to the gains: these are the free unknowns. What is given is held at its
value, its columns only widen the intervals; the delays have rows of their own.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from acquisition.errors import BadInputError, Location
from acquisition.robot import Payload, Robot

from ..arrays import Array, Ints
from ..estimation import Estimate
from ..report import base_name, gain_name, is_base, is_own, own_name
from .blocks import MotionBlock
from .payload import PayloadColumns, payload_columns
from .problem import Problem

# of `own`, and of the terms of the model
KINDS = {"Off": "offset", "Fv": "viscous", "Fc": "coulomb"}


def base_places(names: Sequence[str]) -> Ints:
    """Return the places of the base parameters in names, some of which may be of payloads and
    gains.
    """
    return np.flatnonzero([bool(is_base(name)) for name in names])


@dataclass(frozen=True, kw_only=True, eq=False)
class Arm:
    """The base parameters of one recording, beta = P x + known, of the robot with what it carries:
    the term W beta.

    Attributes:
        names: (b,) of its base parameters without payload, in x.
        unknowns: (p,) names of x.
        P, known: (b, p) and (b,).
        payload: what it carries; None for nothing.
    """

    names: tuple[str, ...]
    unknowns: tuple[str, ...]
    P: Array
    known: Array
    payload: PayloadColumns | None = None

    def beta(self, x: Array) -> Array:
        """Return the base parameters (b,)."""
        return np.asarray(self.P @ x + self.known)

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return F[w IDM] beta, (n, rows), without load-dependent friction."""
        return np.asarray(self.beta(x) @ motion.W)

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return W P, (n, p, rows)."""
        return np.asarray(self.P.T @ motion.W)

    @property
    def own(self) -> set[str]:
        """Names of the parameters that other recordings do not have; those of equal payloads are
        the same.
        """
        return set(filter(is_own, self.names)) | set(self.payload.names if self.payload else ())

    def values(self, estimate: Estimate) -> Array:
        """Return the base parameters (b,) by an estimate, in which unknowns that it lacks are
        zero.
        """
        return self.beta(estimate.values_of(self.unknowns))

    def carried(self, estimate: Estimate) -> Array:
        """Return the payload's share of the base parameters (b,), by an estimate."""
        return self.payload.values(estimate) if self.payload else np.zeros(len(self.names))


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """A value given with a half-width, which an estimate holds; intervals count it.

    Attributes:
        name: in x.
        value: in x.
        half: half-width of its 95 % interval.
        given: changes of the other given values of the free unknowns (f,) per unit.
        column: the torque (n, rows) that it adds per unit about x (p,) along a motion, weighted and
            decimated; None for the gain of a drive, whose term has it.
    """

    name: str
    value: float
    half: float
    stated: Array
    column: Callable[[Array, MotionBlock], Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Stated:
    """The given values as a term: the torques of those that have a column.

    `held` are all, `first` is the place of their first in x.
    """

    held: tuple[Held, ...]
    first: int

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return the torque (n, rows) by x (p,)."""
        return np.asarray(x @ self.columns(x, motion))

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return its derivatives (n, p, rows)."""
        found = np.zeros((len(motion.share), len(x), motion.share.shape[1]))
        for place, held in enumerate(self.held, self.first):
            if held.column is not None:
                found[:, place] = held.column(x, motion)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknowns:
    """The unknowns x of several recordings.

    Attributes:
        names: (f,) of the free ones: base parameters, per-recording ones of a kind in sequence;
            payloads; gains of motors.
        arms: by recording.
        motors: motors whose gains are free.
        gains: their places.
        payloads: of the recordings, each once.
        held: given values.
        groups: places of the recordings with a common delay: those of the same effort object,
            timing
            and rate.
    """

    names: tuple[str, ...]
    arms: tuple[Arm, ...]
    motors: tuple[int, ...]
    gains: slice
    payloads: tuple[PayloadColumns, ...]
    held: tuple[Held, ...]
    groups: tuple[tuple[int, ...], ...]

    @property
    def all(self) -> tuple[str, ...]:
        """Names of x, (p,)."""
        return self.arms[0].unknowns

    @property
    def lags(self) -> Ints:
        """Places of the delays, by group, (K,)."""
        return np.arange(len(self.all) - len(self.groups), len(self.all))

    @property
    def arm(self) -> Ints:
        """Places of the free unknowns but gains."""
        return np.arange(self.gains.start)

    def start(self, lags_s: Sequence[float]) -> Array:
        """Return x (p,) with only given drive gains, given values, and known delays."""
        gains, held = np.ones(len(self.motors)), [stated.value for stated in self.held]
        return np.asarray(np.r_[np.zeros(self.gains.start), gains, held, lags_s])

    @property
    def plain(self) -> bool:
        """True if the free unknowns are the base parameters of every recording."""
        return self.names == self.arms[0].names and not any(arm.payload for arm in self.arms)

    def simulated(self, x: Array, C: Array | None) -> list[tuple[Array, Array | None, Array]]:
        """Return by recording what is simulated for x.

        This is base parameters (b,), their covariance without the payload, and the share (b,) of
        the body nearest to the payload in them. C: covariance of x.
        """
        found = []
        for arm in self.arms:
            at, carried = _places(self.names, arm.names), np.zeros(len(arm.names))
            if arm.payload is not None:
                own = _places(self.names, arm.payload.names)
                phi, _, _ = arm.payload.nearest_body(
                    x[own], None if C is None else C[np.ix_(own, own)]
                )
                # the arm has what is not known of a payload of which nothing is estimated
                carried = arm.payload.whole @ phi if len(own) else arm.known
            found.append((x[at] + carried, None if C is None else C[np.ix_(at, at)], carried))
        return found

    def repeated(self, x: Array, beta: Array) -> Array:
        """Return x with base parameters beta (b,), the same for every recording, without payloads,
        with given gains.
        """
        values = dict(zip(map(base_name, self.arms[0].names), beta, strict=True))
        arm = [values.get(base_name(name), 0.0) for name in self.names[: self.gains.start]]
        return np.asarray(np.r_[arm, np.ones(len(self.motors)), x[len(self.names) :]])


def make_unknowns(
    problems: Sequence[Problem], motors: tuple[int, ...] = (), friction: Sequence[str] = ()
) -> Unknowns:
    """Make the unknowns of several recordings, and the gains of `motors`.

    Per-recording parameters are of the kinds that the first one's description lists, or else of
    those of `friction` that are regrouped with nothing.

    Raises
    ------
    BadInputError : the robot lacks a kind, or gravity or other parameters absorb it.
    """
    robot, labels = problems[0].signals.robot, _labels([one.signals.recording for one in problems])
    names = _base_names(problems[0], labels, friction)
    carried = payload_columns(problems, labels, scale=bool(motors))
    payloads = tuple(dict.fromkeys(payload for payload in carried if payload is not None))
    arm = [
        *dict.fromkeys(name for place in zip(*names, strict=True) for name in place),
        *(name for payload in payloads for name in payload.names),
    ]
    free = (*arm, *(gain_name(robot.motors[m].name) for m in motors))
    held = _held(robot, motors, payloads, free)
    groups = lag_groups(problems)
    x = (*free, *(stated.name for stated in held), *(f"lag {g}" for g in range(len(groups))))
    return Unknowns(
        names=free,
        arms=tuple(_arm(x, *of_one) for of_one in zip(names, carried, strict=True)),
        motors=motors,
        gains=slice(len(arm), len(free)),
        payloads=payloads,
        held=held,
        groups=groups,
    )


def _base_names(
    problem: Problem, labels: Sequence[str], friction: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return by recording the names of its base parameters in x."""
    listed, own = problem.signals.robot.identification.own, list[int]()
    for kind in (friction if listed is None else listed) if len(labels) > 1 else ():
        with suppress(*[BadInputError] * (listed is None)):
            own += _own_places(problem, kind)
    return [
        tuple(
            own_name(name, label) if i in own else name for i, name in enumerate(problem.base.names)
        )
        for label in labels
    ]


def _held(
    robot: Robot,
    motors: tuple[int, ...],
    payloads: Sequence[PayloadColumns],
    free: tuple[str, ...],
) -> tuple[Held, ...]:
    """Return the values given with a half-width: drive gains, beside those of `motors`, masses and
    centres of mass.

    They are in half-widths; `free` are the names of the free unknowns.
    """
    return (
        *(
            Held(
                name=gain_name(motor.name), value=1.0, half=half / gain, stated=np.zeros(len(free))
            )
            for m, (motor, gain) in enumerate(zip(robot.motors, robot.gain, strict=True))
            if (half := motor.drive_gain_half_width) and m not in motors
        ),
        *(
            Held(
                name=f"half-width {i}:{number}",
                value=0.0,
                half=1.0,
                stated=stated,
                column=partial(_with_payload, columns.payload, moves),
            )
            for number, columns in enumerate(payloads)
            for i, (moves, stated) in enumerate(columns.half_widths(free))
        ),
    )


def lag_groups(problems: Sequence[Problem]) -> tuple[tuple[int, ...], ...]:
    """Return places of recordings with a common delay: those of the same effort object, timing and
    rate.
    """
    groups: dict[object, list[int]] = {}
    for k, problem in enumerate(problems):
        signals, known = problem.signals, problem.settings.known_lag
        same = signals.effort_object, signals.effort_timing, signals.sample_rate_hz
        groups.setdefault((*same, known.stated and known.value_s), []).append(k)
    return tuple(map(tuple, groups.values()))


def _arm(x: tuple[str, ...], names: tuple[str, ...], payload: PayloadColumns | None) -> Arm:
    P, known = np.zeros((len(names), len(x))), np.zeros(len(names))
    P[np.arange(len(names)), _places(x, names)] = 1.0
    if payload is not None:
        P[:, _places(x, payload.names)], known = payload.columns, payload.known
    return Arm(names=names, unknowns=x, P=P, known=known, payload=payload)


def _with_payload(payload: Payload, moves: Array, _: Array, motion: MotionBlock) -> Array:
    """Return the torque (n, rows) of `moves` (b,) of the base parameters of recordings with a
    payload.
    """
    return np.asarray(moves @ motion.W * (motion.problem.signals.payload == payload))


def _places(x: tuple[str, ...], names: Sequence[str]) -> Ints:
    return np.array([x.index(name) for name in names], dtype=np.intp)


def _own_places(problem: Problem, kind: str) -> list[int]:
    """Return places of the base parameters of a kind, none of which is regrouped."""
    base, model, found = problem.base, problem.model, list[int]()
    place, key = Location(f"robot {problem.signals.robot.name}"), "identification.own"
    columns = [c for c, term in model.terms.items() if term.kind == KINDS[kind]]
    place.require(
        columns,
        key,
        kind,
        text="no joint has such a parameter",
        advice="Set offset = true of a joint, or remove it"
        if kind == "Off"
        else "Set this friction of a joint, or remove it",
    )
    for c in columns:
        alone = np.flatnonzero((base.columns == c) & (np.count_nonzero(base.K, axis=1) == 1))
        place.require(
            len(alone),
            key,
            kind,
            text=f"{model.names[c]} cannot be distinguished from other parameters, as an offset "
            "from gravity",
            advice="Remove it",
        )
        found += alone.tolist()
    return found


def _labels(recordings: Sequence[str]) -> list[str]:
    """Return short names of recordings: without their endings, and numbered if these are not
    unique.
    """
    stems = [Path(name).stem for name in recordings]
    unique = len(set(stems)) == len(stems)
    return stems if unique else [f"{stem}#{k}" for k, stem in enumerate(stems, 1)]
