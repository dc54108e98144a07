"""The system of several recordings, and own parameters of each, such as an offset: Off1@A and Off1@B for Off1."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..errors import IdentificationError
from ..estimation import stacked
from .problem import Problem
from .system import Regression

KINDS = {"Off": "offset", "Fv": "viscous", "Fc": "coulomb"}  # of `own`, and of the terms of the model


def base_name(name: str) -> str:
    """The name without its recording: Off1 of Off1@A."""
    return name.partition("@")[0]


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnParameters:
    """The parameters of several recordings: shared ones, and own ones of each.

    Attributes:
        of: by recording, the (b,) names of its base parameters.
        names: of all recordings, those of an own parameter in sequence.
    """

    of: tuple[tuple[str, ...], ...]
    names: tuple[str, ...]

    @property
    def any(self) -> bool:
        """Whether a recording has a parameter of its own."""
        return any("@" in name for name in self.names)

    def places(self, k: int) -> NDArray[np.intp]:
        """Places (b,) of the base parameters of recording k in all."""
        return np.array([self.names.index(name) for name in self.of[k]])

    def columns(self, X: Array, k: int) -> Array:
        """X (r, b) of recording k in the columns of all parameters; zero in those of other recordings."""
        if not self.any:
            return X
        wide = np.zeros((len(X), len(self.names)))
        wide[:, self.places(k)] = X
        return wide

    def repeated(self, beta: Array) -> Array:
        """Values of all parameters from base parameters beta (b,), the same for every recording."""
        places = {name: i for i, name in enumerate(map(base_name, self.of[0]))}
        return np.array([beta[places[base_name(name)]] for name in self.names])

    def stacked(self, each: Sequence[Regression]) -> Regression:
        """The system of the recordings, with the columns of all parameters. Raises for own ones with reduced rows."""
        if self.any and each[0].reduced:
            text = "the recordings are too long for parameters of their own"
            raise IdentificationError(text, key="identification.own", expected="a larger --decimate, or none")
        if self.any:
            wide = [
                replace(one.system, W=self.columns(one.system.W, k), names=self.names) for k, one in enumerate(each)
            ]
            each = [replace(one, system=system) for one, system in zip(each, wide, strict=True)]
        return _stacked(each)


def own_parameters(problems: Sequence[Problem]) -> OwnParameters:
    """The parameters of several recordings, by `own` of the first one's description.

    Raises `IdentificationError` for a kind that the robot lacks, or that gravity or other parameters absorb.
    """
    base = problems[0].base
    own = _own_places(problems[0]) if len(problems) > 1 else []
    labels = _labels([problem.signals.recording for problem in problems])
    of = tuple(tuple(f"{n}@{label}" if i in own else n for i, n in enumerate(base.names)) for label in labels)
    names = []
    for i, name in enumerate(base.names):
        names += [one[i] for one in of] if i in own else [name]
    return OwnParameters(of=of, names=tuple(names))


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
        fast=np.concatenate([part.fast for part in regressions]),
        tau=np.concatenate([part.tau for part in regressions]),
        speed=np.concatenate([part.speed for part in regressions]),
        slip_noise=np.max([part.slip_noise for part in regressions], axis=0),
        reduced=regressions[0].reduced,
    )
