"""The system of several recordings, and own parameters of each, such as an offset: Off1@A and Off1@B for Off1."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import Estimate, stacked
from .payload import PayloadColumns, payload_columns
from .problem import Problem
from .system import Regression

KINDS = {"Off": "offset", "Fv": "viscous", "Fc": "coulomb"}  # of `own`, and of the terms of the model


def base_places(names: Sequence[str]) -> NDArray[np.intp]:
    """Places of the base parameters in names, some of which may be of payloads and gains: MX:loaded, K:motor_1."""
    return np.flatnonzero([":" not in name for name in names])


def base_name(name: str) -> str:
    """The name without its recording: Off1 of Off1@A."""
    return name.partition("@")[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingParameters:
    """The base parameters of one recording in those of all: its own, and those of its payload.

    Attributes:
        names: (b,) of its base parameters without payload.
        payload: what it carries; None for nothing.
    """

    names: tuple[str, ...]
    payload: PayloadColumns | None = None

    @property
    def own(self) -> set[str]:
        """Names of the parameters that other recordings do not have; those of equal payloads are the same."""
        return {name for name in self.names if "@" in name} | set(self.payload.names if self.payload else ())

    def values(self, estimate: Estimate) -> Array:
        """(b,) base parameters of the robot with its payload by an estimate, zero for those not estimated."""
        beta = estimate.values_of(self.names)
        return beta if self.payload is None else beta + self.payload.values(estimate)

    def settled(self, estimate: Estimate) -> "RecordingParameters":
        """The same with all of the payload known, by an estimate."""
        if self.payload is None:
            return self
        known, none = self.payload.values(estimate), np.zeros((len(self.names), 0))
        return replace(self, payload=replace(self.payload, names=(), known=known, columns=none))


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnParameters:
    """The parameters x of several recordings: shared ones, own ones and payloads of each, gains of motors.

        W_k beta_k - sum_m E_m kappa_m = known torques,    beta_k = base parameters + payload

    E_m is the torque of motor m at the joints by its described gain, kappa_m the factor on that gain.

    Attributes:
        of: by recording.
        names: of all recordings, those of an own parameter in sequence; then payloads, then gains.
        motors: whose gains are parameters.
        plain: whether the parameters are the base parameters.
    """

    of: tuple[RecordingParameters, ...]
    names: tuple[str, ...]
    motors: tuple[int, ...]
    plain: bool

    @property
    def any(self) -> bool:
        """Whether a recording has a parameter of its own."""
        return any("@" in name for name in self.names)

    @property
    def gains(self) -> slice:
        """Places of the gains."""
        return slice(len(self.names) - len(self.motors), len(self.names))

    def places(self, k: int, names: Sequence[str] | None = None) -> NDArray[np.intp]:
        """Places of the base parameters (b,) of recording k in all, or of other names."""
        return np.array(
            [self.names.index(name) for name in (self.of[k].names if names is None else names)], dtype=np.intp
        )

    def base(self, x: Array, k: int) -> Array:
        """(b,) base parameters of recording k, with its payload, by all parameters x."""
        carried, beta = self.of[k].payload, np.asarray(x[self.places(k)])
        return beta if carried is None else beta + carried.known + carried.columns @ x[self.places(k, carried.names)]

    def simulated(self, x: Array, C: Array | None) -> list[tuple[Array, Array | None, Array]]:
        """By recording what is simulated for all parameters x: base parameters (b,), their covariance without the payload, and
        the share (b,) of the body nearest to the payload in them. C: covariance of x.
        """
        found = []
        for k, one in enumerate(self.of):
            at, carried = self.places(k), np.zeros(len(one.names))
            if one.payload is not None:
                own = self.places(k, one.payload.names)
                phi, _, _ = one.payload.nearest_body(x[own], None if C is None else C[np.ix_(own, own)])
                carried = one.payload.whole @ phi
            found.append((x[at] + carried, None if C is None else C[np.ix_(at, at)], carried))
        return found

    def columns(self, X: Array, k: int, drives: Array | None = None) -> Array:
        """X (r, b) of recording k in the columns of all parameters; zero in those of other recordings.

        `drives` (n, rows, m), torques at the joints of all motors, give the columns of the gains.
        """
        if self.plain:
            return X
        wide, carried = np.zeros((len(X), len(self.names))), self.of[k].payload
        wide[:, self.places(k)] = X
        if carried is not None and carried.names:
            wide[:, self.places(k, carried.names)] = X @ carried.columns
        if drives is not None and self.motors:
            wide[:, self.gains] = -drives[..., self.motors].reshape(len(X), -1)
        return wide

    def repeated(self, beta: Array) -> Array:
        """Values of all parameters from base parameters beta (b,), the same for every recording; gains as described."""
        values = dict(zip(map(base_name, self.of[0].names), beta, strict=True))
        x = np.array([values.get(base_name(name), 0.0) for name in self.names])
        x[self.gains] = 1.0
        return x

    def stacked(self, each: Sequence[Regression], drives: Sequence[Array]) -> Regression:
        """The system of the recordings, with the columns of all parameters. Raises for others than base parameters with
        reduced rows.
        """
        if each[0].reduced and not self.plain:
            key = "gains" if self.motors else "identification.own" if self.any else "payload"
            text = "the recordings are too long for parameters of their own, payloads and drive gains"
            raise IdentificationError(text, key=key, expected="a larger decimation, or none")
        if not self.plain:
            each = [self._wide(one, k, drives[k] if drives else None) for k, one in enumerate(each)]
        return _stacked(each)

    def _wide(self, one: Regression, k: int, drives: Array | None) -> Regression:
        carried, W, Y = self.of[k].payload, one.system.W, one.system.Y
        if carried is not None:
            Y = Y - W @ carried.known
        if drives is not None and self.motors:
            Y = Y - drives[..., self.motors].sum(axis=2).reshape(-1)
        return replace(one, system=replace(one.system, W=self.columns(W, k, drives), Y=Y, names=self.names))


def own_parameters(problems: Sequence[Problem], motors: tuple[int, ...] = ()) -> OwnParameters:
    """The parameters of several recordings, by `own` of the first one's description, and the gains of `motors`.

    Raises `IdentificationError` for a kind that the robot lacks, or that gravity or other parameters absorb.
    """
    base, robot = problems[0].base, problems[0].signals.robot
    own = _own_places(problems[0]) if len(problems) > 1 else []
    labels = _labels([problem.signals.recording for problem in problems])
    of = tuple(tuple(f"{n}@{label}" if i in own else n for i, n in enumerate(base.names)) for label in labels)
    names = []
    for i, name in enumerate(base.names):
        names += [one[i] for one in of] if i in own else [name]
    carried = payload_columns(problems, labels)
    names += dict.fromkeys(name for one in carried if one is not None for name in one.names)
    whole = (*names, *(f"K:{robot.motors[m].name}" for m in motors))
    return OwnParameters(
        of=tuple(RecordingParameters(names=n, payload=one) for n, one in zip(of, carried, strict=True)),
        names=whole,
        motors=motors,
        plain=whole == of[0] and not any(carried),
    )


def _own_places(problem: Problem) -> list[int]:
    base, model, robot, found = problem.base, problem.model, problem.signals.robot, []
    for kind in robot.identification.own:
        columns = [c for c, s in enumerate(model.sources) if getattr(s, "kind", None) == KINDS[kind]]
        if not columns:
            expected = "offset = true of a joint" if kind == "Off" else "joints with this friction"
            raise IdentificationError(
                "no joint has it", place=f"robot {robot.name}", key="identification.own", value=kind, expected=expected
            )
        for c in columns:
            alone = [i for i in range(base.b) if base.columns[i] == c and np.count_nonzero(base.K[i]) == 1]
            if not alone:
                raise IdentificationError(
                    f"{model.names[c]} cannot be distinguished from other parameters (gravity absorbs an offset)",
                    place=f"robot {robot.name}",
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


def _stacked(regressions: Sequence[Regression]) -> Regression:
    """The system of several recordings, rows stacked joint by joint, in the order given: all of them reduced, or none."""
    if len(regressions) == 1:
        return regressions[0]
    return Regression(
        system=stacked([part.system for part in regressions]),
        share=np.concatenate([part.share for part in regressions]),
        tau=np.concatenate([part.tau for part in regressions]),
        speed=np.concatenate([part.speed for part in regressions]),
        reduced=regressions[0].reduced,
    )
