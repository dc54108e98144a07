"""The unknowns x of a fit, and the base parameters of each recording in them.

    beta_k = P_k x + known_k

P_k and known_k are constant. A base parameter, common or of recording k alone, is a unit column of
P_k. The estimated part of a payload K_n phi has further columns; its known part is in known_k. x
has, in this order:

    Fv1, Off1@A, Off1@B, ZZ2 ...    base parameters as in the model; per-recording parameters are
                                    in the order of the recordings, at the place of the common one
    MX:loaded ...                   estimated parameters of each payload
    K:motor_1 ...                   drive gains, as factors on the given ones
    K:motor_2, half-width 0:0 ...   values that are given with a half-width
    lag 0 ...                       the delay of each group of recordings

The first three, up to the drive gains, are the free unknowns, which the rows determine. A value
given with a half-width is held; its columns only widen the intervals. Delays have rows of their
own.
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
from ..report import base_name, gain_name, is_own, own_name
from .blocks import MotionBlock
from .payload import PayloadColumns, payload_columns
from .problem import Problem

# Kinds of `identification.own`, and the kinds of terms that they stand for.
KINDS = {"Off": "offset", "Fv": "viscous", "Fc": "coulomb"}


@dataclass(frozen=True, kw_only=True, eq=False)
class Arm:
    """The term W beta of a recording: the base parameters of the robot with its payload.

        beta = P x + known

    Attributes:
        names: (b,) names of the base parameters without payload, in x.
        unknowns: (p,) names of x.
        P: (b, p) matrix.
        known: (b,) base parameters of the known part of the payload.
        payload: payload; None for none.
    """

    names: tuple[str, ...]
    unknowns: tuple[str, ...]
    P: Array
    known: Array
    payload: PayloadColumns | None = None

    def beta(self, x: Array) -> Array:
        """Return the base parameters (b,) at x (p,)."""
        return np.asarray(self.P @ x + self.known)

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return F[w IDM] beta, (n, rows), without load-dependent friction."""
        return np.asarray(self.beta(x) @ motion.W)

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return W P, (n, p, rows)."""
        return np.asarray(self.P.T @ motion.W)

    @property
    def own(self) -> set[str]:
        """Names of the per-recording parameters; those of equal payloads are the same."""
        return set(filter(is_own, self.names)) | set(self.payload.names if self.payload else ())

    def values(self, estimate: Estimate) -> Array:
        """Return the base parameters (b,) of an estimate; unknowns that it lacks are zero."""
        return self.beta(estimate.values_of(self.unknowns))

    def carried(self, estimate: Estimate) -> Array:
        """Return the payload's share of the base parameters (b,), by an estimate."""
        return self.payload.values(estimate) if self.payload else np.zeros(len(self.names))


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """A value given with a half-width; an estimate holds it, and intervals include it.

    Attributes:
        name: name in x.
        value: value in x.
        half: half-width of its 95 % interval.
        stated: (f,) changes of the other given values among the free unknowns, per unit.
        column: function that returns the torque (n, rows) per unit at x (p,) along a motion,
            weighted and decimated; None for a drive gain, whose term has it.
    """

    name: str
    value: float
    half: float
    stated: Array
    column: Callable[[Array, MotionBlock], Array] | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Stated:
    """The given values as a term: the torques of those that have a column.

    Attributes:
        held: all given values.
        first: place of the first one in x.
    """

    held: tuple[Held, ...]
    first: int

    def torque(self, x: Array, motion: MotionBlock) -> Array:
        """Return the torque (n, rows) at x (p,)."""
        return np.asarray(x @ self.columns(x, motion))

    def columns(self, x: Array, motion: MotionBlock) -> Array:
        """Return the derivatives (n, p, rows) of the torque."""
        found = np.zeros((len(motion.share), len(x), motion.share.shape[1]))
        for place, held in enumerate(self.held, self.first):
            if held.column is not None:
                found[:, place] = held.column(x, motion)
        return found


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknowns:
    """The unknowns x of several recordings.

    Attributes:
        names: (f,) names of the free unknowns: base parameters (per-recording ones of a kind in
            sequence), payloads, drive gains.
        arms: term of the base parameters, by recording.
        motors: motors whose drive gains are free.
        gains: places of these gains in x.
        payloads: payloads of the recordings, each once.
        held: values given with a half-width.
        groups: recordings with a common delay: same effort object, timing and rate.
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
        """Places (K,) of the delays, by group."""
        return np.arange(len(self.all) - len(self.groups), len(self.all))

    @property
    def arm(self) -> Ints:
        """Places of the free unknowns without the drive gains."""
        return np.arange(self.gains.start)

    def start(self, lags_s: Sequence[float]) -> Array:
        """Return x (p,) of given drive gains, values and delays; all others are zero."""
        gains, held = np.ones(len(self.motors)), [stated.value for stated in self.held]
        return np.asarray(np.r_[np.zeros(self.gains.start), gains, held, lags_s])

    @property
    def plain(self) -> bool:
        """True if the free unknowns are the base parameters of every recording."""
        return self.names == self.arms[0].names and not any(arm.payload for arm in self.arms)

    def simulated(self, x: Array, C: Array | None) -> list[tuple[Array, Array | None, Array]]:
        """Return by recording what is simulated for x (p,) with covariance C (p, p).

        This is base parameters (b,), their covariance (b, b) without the payload, and the share
        (b,) of the rigid body nearest to the payload in them.
        """
        found = []
        for arm in self.arms:
            at, carried = _places(self.names, arm.names), np.zeros(len(arm.names))
            if arm.payload is not None:
                own = _places(self.names, arm.payload.names)
                phi, _, _ = arm.payload.nearest_body(
                    x[own], None if C is None else C[np.ix_(own, own)]
                )
                # If nothing of the payload is estimated, the arm's parameters include its unknown
                # part.
                carried = arm.payload.whole @ phi if len(own) else arm.known
            found.append((x[at] + carried, None if C is None else C[np.ix_(at, at)], carried))
        return found

    def repeated(self, x: Array, beta: Array) -> Array:
        """Return x (p,) with base parameters beta (b,) in every recording.

        Payloads are zero and drive gains those given.
        """
        values = dict(zip(map(base_name, self.arms[0].names), beta, strict=True))
        arm = [values.get(base_name(name), 0.0) for name in self.names[: self.gains.start]]
        return np.asarray(np.r_[arm, np.ones(len(self.motors)), x[len(self.names) :]])


def make_unknowns(
    problems: Sequence[Problem], motors: tuple[int, ...] = (), friction: Sequence[str] = ()
) -> Unknowns:
    """Make the unknowns of several recordings.

    Parameters
    ----------
    problems : the recordings.
    motors : motors whose drive gains are unknowns.
    friction : kinds of per-recording parameters, if the description of the first recording lists
        none. Parameters of these kinds that others are regrouped with stay common.

    Raises
    ------
    BadInputError : the robot has no parameter of a listed kind, or it is regrouped with others.
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
    """Return the values given with a half-width, in half-widths.

    These are drive gains of other motors than `motors`, masses, and centres of mass. `free` are the
    names of the free unknowns.
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
    """Return the recordings with a common delay: same effort object, timing and rate."""
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
    """Return the torque (n, rows) of changes `moves` (b,), zero without this payload."""
    return np.asarray(moves @ motion.W * (motion.problem.signals.payload == payload))


def _places(x: tuple[str, ...], names: Sequence[str]) -> Ints:
    return np.array([x.index(name) for name in names], dtype=np.intp)


def _own_places(problem: Problem, kind: str) -> list[int]:
    """Return the places of the base parameters of a kind; refuse regrouped ones."""
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
    """Return short names of recordings: without endings, and numbered if not unique."""
    stems = [Path(name).stem for name in recordings]
    unique = len(set(stems)) == len(stems)
    return stems if unique else [f"{stem}#{k}" for k, stem in enumerate(stems, 1)]
