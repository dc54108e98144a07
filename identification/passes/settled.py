"""Least squares of a robot with friction terms that a recording may not tell, or that depend on the estimate before.

A term whose column is nearly the sum of others is left out, by name. Load friction goes by the links' torque of the pass
before (`regression.load`): passes end where every parameter changes by less than half a deviation. The load friction of a
joint that does not settle is left out, by name.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import Estimate, System, ordinary_least_squares, weighted_least_squares
from ..model import SHAPES, JointTerm
from ..regression import LoadFriction, Problem, Regression
from .linearised import LinearisedRecording

TOLD_APART = 0.02  # share of a column's norm that the other columns must leave for its parameter to say anything
MOST_PASSES = 10
ROUNDING = 1e-10  # of the largest change that counts, beside half a deviation: exact data have none


@dataclass(frozen=True, kw_only=True, eq=False)
class Settled:
    """Least squares of a recording with the terms that it tells.

    Attributes:
        problem: without the terms that were left out; its warnings name them.
        recording: W and Y about any parameters; `observed` about the pass before the last.
        full: least squares of all base parameters.
    """

    problem: Problem
    recording: LinearisedRecording
    observed: Regression
    full: Estimate


def settled_least_squares(problem: Problem, plain: Regression, method: Literal["ols", "wls"] = "wls") -> Settled:
    """Least squares of all parameters that the recording tells.

    Parameters
    ----------
    problem : the identification.
    plain : its regression, columns of load friction zero.
    method : `wls` or `ols`.

    Raises
    ------
    IdentificationError : as of the estimators.
    """
    problem, plain = leave_out_untold(problem, plain)
    while True:
        recording = LinearisedRecording(problem, plain)
        settled, unsettled = _settle(problem, recording, method)
        if settled is not None:
            return settled
        problem, plain = without(problem, plain, unsettled)


def without(problem: Problem, regression: Regression, left_out: dict[str, str]) -> tuple[Problem, Regression]:
    """The identification without parameters, and the regression without their columns; warnings give the reasons."""
    if not left_out:
        return problem, regression
    base, settings = problem.base.without(left_out), problem.settings
    settings = replace(settings, warnings=(*settings.warnings, *left_out.values()))
    columns = _others(regression.system, left_out)
    place = np.cumsum([name not in left_out for name in problem.base.names]) - 1
    links = tuple(
        replace(part, entries=np.c_[part.entries[:, 0], place[part.entries[:, 1]]]) for part in regression.links
    )
    plain = replace(regression, system=regression.system.with_columns(columns), links=links)
    return replace(problem, base=base, settings=settings), plain


def without_load(system: System, load: LoadFriction) -> System:
    """The system without the columns of load friction."""
    return system.with_columns(np.setdiff1d(np.arange(len(system.names)), load.places))


@dataclass(frozen=True, kw_only=True, eq=False)
class LoadPasses:
    """Passes of an estimate, each with the links' torque of the one before.

    Attributes:
        observed, estimate: of the last pass.
        settled: whether it changed no parameter by more than half a deviation; `unsettled` are otherwise the parameters of
            load friction that did, or the one that changed most, with a line that says it.
    """

    observed: Regression
    estimate: Estimate
    unsettled: dict[str, str]

    @property
    def settled(self) -> bool:
        """Whether every parameter has settled."""
        return not self.unsettled


def load_passes(
    problem: Problem,
    recording: LinearisedRecording,
    solve: Callable[[Regression], Estimate],
    beta: Array,
    load: LoadFriction,
) -> LoadPasses:
    """Solve from the parameters `beta` (b,) on, until they settle or there were ten passes.

    `solve` gives an estimate, of some parameters or all, from W and Y about the parameters before; of load friction it has
    that of `load`.
    """
    names, passes, values = problem.base.names, MOST_PASSES if load else 1, list[Array]()
    for _ in range(passes):
        observed = recording.at(beta, load)
        estimate = solve(observed)
        after, sigma = estimate.among(names), np.zeros(len(names))
        sigma[[names.index(name) for name in estimate.names]] = estimate.sigma
        off = np.abs(after - beta) / np.maximum(sigma / 2, ROUNDING * np.abs(after).max())
        beta = after
        values.append(beta)
        if not load or (off < 1).all():
            return LoadPasses(observed=observed, estimate=estimate, unsettled={})
    unsettled, own = {}, off[load.places]
    for j, place, far in zip(load.joints, load.places, own, strict=True):
        if far >= 1 or far == own.max():
            mu, joint = names[place], problem.signals.robot.joints[j].name
            last = ", ".join(f"{value[place]:.3g}" for value in values[-3:])
            unsettled[mu] = f"load friction of joint {joint} left out: it does not settle ({mu} {last})"
    return LoadPasses(observed=observed, estimate=estimate, unsettled=unsettled)


def _settle(
    problem: Problem, recording: LinearisedRecording, method: Literal["ols", "wls"]
) -> tuple[Settled | None, dict[str, str]]:
    """Pass by pass; or else which load friction does not settle, or is not told apart, and why."""
    solve = weighted_least_squares if method == "wls" else ordinary_least_squares
    names, load, beta = problem.base.names, recording.load, np.zeros(problem.base.b)
    if load:
        beta = solve(without_load(recording.plain.system, load)).among(names)
        untold = alike(problem, recording.at(beta).system, [names[i] for i in load.places])
        if untold:
            return None, untold
    passes = load_passes(problem, recording, lambda observed: solve(observed.system), beta, load)
    if not passes.settled:
        return None, passes.unsettled
    return Settled(problem=problem, recording=recording, observed=passes.observed, full=passes.estimate), {}


def leave_out_untold(problem: Problem, plain: Regression) -> tuple[Problem, Regression]:
    """The identification without the friction terms, load friction apart, that are nearly a sum of other columns."""
    return without(problem, plain, untold_terms(problem, plain.system))


def untold_terms(problem: Problem, system: System) -> dict[str, str]:
    """The friction terms, load friction apart, that are nearly a sum of other columns of a system, one after the other."""
    shapes = [
        name
        for name, c in zip(problem.base.names, problem.base.columns, strict=True)
        if isinstance(source := problem.model.sources[c], JointTerm) and source.kind in SHAPES and source.kind != "load"
    ]
    untold = dict[str, str]()
    while left_out := alike(problem, system, shapes):
        untold |= left_out
        system = system.with_columns(_others(system, left_out))
        shapes = [name for name in shapes if name not in left_out]
    return untold


def _others(system: System, left_out: Collection[str]) -> NDArray[np.intp]:
    """Places of the columns of a system that are not left out."""
    return np.array([i for i, name in enumerate(system.names) if name not in left_out])


def alike(problem: Problem, system: System, among: Collection[str]) -> dict[str, str]:
    """Of these parameters the one whose column is most like a sum of others, if too much so, and a line that says it."""
    shares = told_apart(system, among)
    lowest = min(shares, key=lambda name: shares[name], default=None)
    if lowest is None or shares[lowest] >= TOLD_APART:
        return {}
    source = problem.model.sources[problem.base.columns[problem.base.names.index(lowest)]]
    assert isinstance(source, JointTerm)
    joint, left = problem.signals.robot.joints[int(source.rows[-1])].name, f"{100 * shares[lowest]:.1f} % of its column"
    told = f"{source.kind} friction of joint {joint} left out: {lowest} cannot be told from the other parameters"
    return {lowest: f"{told}, which leave {left}"}


def told_apart(system: System, names: Collection[str]) -> dict[str, float]:
    """By parameter the share of its column's norm that the other columns leave, in the rows that count."""
    if not names:
        return {}
    W, _ = system.weighted(np.ones(len(system.rows)))
    norms = np.linalg.norm(W, axis=0)
    seen = norms > 1e-12 * norms.max()
    R: Array = np.asarray(np.linalg.qr(W[:, seen] / norms[seen], mode="r"))
    kept = [name for name, s in zip(system.names, seen, strict=True) if s]
    shares = dict.fromkeys(names, 0.0)
    for name in names:
        if name in kept:
            i = kept.index(name)
            others = np.delete(R, i, axis=1)
            shares[name] = float(np.linalg.norm(R[:, i] - others @ np.linalg.lstsq(others, R[:, i], rcond=1e-12)[0]))
    return shares
