"""The unknowns x of a fit, and the base parameters of each recording in them.

    beta_k = P_k x + known_k

    columns of x in recording k: W P_k, and -E_m for the gain kappa_m of a drive

P_k and known_k are constant. A shared base parameter, or one of recording k alone (Off1@A), is a
unit column of P_k; the free part of a payload K_n phi are further columns, its known part is in
known_k. E_m is the torque of motor m at the joints by its described gain: with the gain as an
unknown its torque goes from Y to the columns.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import BadInputError
from ..estimation import Estimate
from .payload import PayloadColumns, payload_columns
from .problem import Problem

# of `own`, and of the terms of the model
KINDS = {"Off": "offset", "Fv": "viscous", "Fc": "coulomb"}


def base_places(names: Sequence[str]) -> NDArray[np.intp]:
    """Places of the base parameters in names, some of which may be of payloads and
    gains: MX:loaded, K:motor_1.
    """
    return np.flatnonzero([":" not in name for name in names])


def base_name(name: str) -> str:
    """The name without its recording: Off1 of Off1@A."""
    return name.partition("@")[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class Arm:
    """The base parameters of one recording, beta = P x + known, of the robot with what it carries.

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

    @property
    def own(self) -> set[str]:
        """Names of the parameters that other recordings do not have; those of equal
        payloads are the same.
        """
        return {name for name in self.names if "@" in name} | set(
            self.payload.names if self.payload else ()
        )

    def values(self, estimate: Estimate) -> Array:
        """(b,) base parameters by an estimate, in which unknowns that it lacks are zero."""
        return np.asarray(self.P @ estimate.values_of(self.unknowns) + self.known)

    def settled(self, estimate: Estimate) -> "Arm":
        """The same with all of the payload known, by an estimate."""
        if self.payload is None:
            return self
        carried = self.payload.values(estimate)
        of_arm = np.isin(self.unknowns, self.names)
        return replace(
            self, P=self.P * of_arm, known=carried, payload=replace(self.payload, known=carried)
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class Unknowns:
    """The unknowns x of several recordings: base parameters, those of an own kind in sequence;
    payloads; gains of motors.

    Attributes:
        names: (p,) of x.
        arms: by recording.
        motors: whose gains are unknown.
        payloads: of the recordings, each once.
    """

    names: tuple[str, ...]
    arms: tuple[Arm, ...]
    motors: tuple[int, ...]
    payloads: tuple[PayloadColumns, ...]

    @property
    def plain(self) -> bool:
        """Whether x are the base parameters of every recording."""
        return self.names == self.arms[0].names and not any(arm.payload for arm in self.arms)

    @property
    def own(self) -> tuple[str, ...]:
        """Names of the base parameters that are of one recording each."""
        return tuple(name for name in self.names if "@" in name)

    @property
    def gains(self) -> slice:
        """Places of the gains."""
        return slice(len(self.names) - len(self.motors), len(self.names))

    def beta(self, x: Array, k: int) -> Array:
        """(b,) base parameters of recording k."""
        return np.asarray(self.arms[k].P @ x + self.arms[k].known)

    def simulated(self, x: Array, C: Array | None) -> list[tuple[Array, Array | None, Array]]:
        """By recording what is simulated for x: base parameters (b,), their covariance without the
        payload, and the share (b,) of the body nearest to the payload in them. C: covariance of x.
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

    def columns(self, k: int, WE: Array) -> Array:
        """Columns (r, p) of x in recording k from [W E] (r, b + n): W P_k, and -E_m
        of the drives' torques.
        """
        b = len(self.arms[k].names)
        if self.plain:
            return WE[:, :b]
        found = np.asarray(WE[:, :b] @ self.arms[k].P)
        if self.motors:
            found[:, self.gains] = -WE[:, b:][:, self.motors]
        return found

    def repeated(self, beta: Array) -> Array:
        """x from base parameters beta (b,), the same for every recording; gains as described."""
        values = dict(zip(map(base_name, self.arms[0].names), beta, strict=True))
        x = np.array([values.get(base_name(name), 0.0) for name in self.names])
        x[self.gains] = 1.0
        return x


def make_unknowns(
    problems: Sequence[Problem], motors: tuple[int, ...] = (), friction: Sequence[str] = ()
) -> Unknowns:
    """The unknowns of several recordings, and the gains of `motors`.

    Own parameters are of the kinds that the first one's description lists, or else of those of
    `friction` that stand alone.

    Raises `BadInputError` for a kind that the robot lacks, or that gravity or
    other parameters absorb.
    """
    base, robot = problems[0].base, problems[0].signals.robot
    own = list[int]()
    if len(problems) > 1:
        listed = robot.identification.own
        for kind in friction if listed is None else listed:
            with suppress(*[BadInputError] * (listed is None)):
                own += _own_places(problems[0], kind)
    labels = _labels([problem.signals.recording for problem in problems])
    of = [
        tuple(f"{n}@{label}" if i in own else n for i, n in enumerate(base.names))
        for label in labels
    ]
    carried = payload_columns(problems, labels, scale=bool(motors))
    names = [
        name
        for i, name in enumerate(base.names)
        for name in ([one[i] for one in of] if i in own else [name])
    ]
    payloads = tuple(dict.fromkeys(one for one in carried if one is not None))
    names += [name for one in payloads for name in one.names]
    x = (*names, *(f"K:{robot.motors[m].name}" for m in motors))
    arms = tuple(_arm(x, *one) for one in zip(of, carried, strict=True))
    return Unknowns(names=x, arms=arms, motors=motors, payloads=payloads)


def _arm(x: tuple[str, ...], names: tuple[str, ...], payload: PayloadColumns | None) -> Arm:
    P, known = np.zeros((len(names), len(x))), np.zeros(len(names))
    P[np.arange(len(names)), _places(x, names)] = 1.0
    if payload is not None:
        P[:, _places(x, payload.names)], known = payload.columns, payload.known
    return Arm(names=names, unknowns=x, P=P, known=known, payload=payload)


def _places(x: tuple[str, ...], names: Sequence[str]) -> NDArray[np.intp]:
    return np.array([x.index(name) for name in names], dtype=np.intp)


def _own_places(problem: Problem, kind: str) -> list[int]:
    base, model, place, found = (
        problem.base,
        problem.model,
        f"robot {problem.signals.robot.name}",
        list[int](),
    )
    columns = [c for c, s in enumerate(model.sources) if getattr(s, "kind", None) == KINDS[kind]]
    if not columns:
        raise BadInputError(
            "no joint has it",
            place=place,
            key="identification.own",
            value=kind,
            expected="offset = true of a joint" if kind == "Off" else "joints with this friction",
        )
    for c in columns:
        alone = [
            i for i in range(base.b) if base.columns[i] == c and np.count_nonzero(base.K[i]) == 1
        ]
        if not alone:
            raise BadInputError(
                f"{model.names[c]} cannot be distinguished from other parameters (gravity absorbs "
                "an offset)",
                place=place,
                key="identification.own",
                value=kind,
                expected="a kind whose parameters stand alone in the base parameters",
            )
        found += alone
    return found


def _labels(recordings: Sequence[str]) -> list[str]:
    """Short names of recordings: without their endings, and numbered if these are not unique."""
    stems = [Path(name).stem for name in recordings]
    if len(set(stems)) == len(stems):
        return stems
    return [f"{stem}#{k}" for k, stem in enumerate(stems, 1)]
