"""Terms that the model may lack: columns added to W one by one, each with the share of the
residual that it explains.

With z = c - Q (QᵀW)⁻ᵀ Wᵀc, a column c made orthogonal to W by the instruments' span Q, its
coefficient is g = zᵀrho / zᵀc. Its deviation is that of the scores z rho' / zᵀc by
equal-weighted cosines, where rho' is the residual with the column, divided by the share that
estimate and column leave of white noise: a slow column removes much of the low frequencies. With
instruments, c is the column of the simulated motion, so that position noise does not bias g.
Columns have the weights of W.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import deviations_of_sums
from ..report import Assumed
from . import candidates
from .fit_data import FitData
from .lines import TrustLine

MAX_TIE_PERCENT = 2.0  # of the residual's square: kinds within this are indistinguishable
# share of a column's norm outside the span of W, for a usable coefficient
MIN_INDEPENDENT_NORM = 0.01
# the same, and of a column's norm beside the torque's: below, it is rounding and biases nothing
MIN_BIAS = 1e-6
MARGIN_T = 2.0  # deviations above MIN_T, at which nearly every recording shows it
# error of a zero; a larger one that is not noticed is assumed away
MAX_UNNOTICED = {"deg": 2.0, "mm": 10.0}


def added_columns_test(evidence: FitData) -> TrustLine:
    """Whether the model lacks a term: friction, a rotor, an offset, a spring, a tilt, a zero,
    a gain, a lag, clocks.
    """
    name, every = "added columns", missing_terms(evidence)
    assumed, terms = tuple(_assumed(every)), [term for term in every if np.isfinite(term.noticed)]
    if not terms:
        return TrustLine(
            name, "not made", "not made: the model has every term that is tried", assumed=assumed
        )
    found = [term for term in terms if term.found]
    first = max(found or terms, key=_rank)
    strongest = f"{first.kind} {first.where} {first.value:.3g} {first.unit}".rstrip()
    strongest += f", t = {first.t:.1f}, {first.taken_percent:.1f} % of the residual"
    if not found:
        robot = evidence.problem.signals.robot
        untried = (
            "" if robot.gain_known else "; relative gains not tried: the drive gains are not known"
        )
        untried = "; one joint has no relative gain" if robot.n == 1 else untried
        text = f"no missing term found ({len(terms)} tried; strongest: {strongest}){untried}"
        return TrustLine(name, "ok", text, first.t, assumed=assumed)
    more = f"; {len(found) - 1} more with t above {candidates.MIN_T:g}" if len(found) > 1 else ""
    text = f"{strongest}{more}: {first.advice}"
    return TrustLine(name, "caution", text, first.t, finding=first.finding, assumed=assumed)


def _assumed(terms: Sequence[candidates.MissingTerm]) -> Iterator[Assumed]:
    """Zeros whose large error is not noticed, and rotors that the description denies."""
    for kind, value, why in (
        (
            candidates.ZERO,
            "right at {}",
            "a wrong zero turns the links' parameters; not noticed: {}",
        ),
        (
            candidates.ROTOR,
            "none at {} (rotor_inertia = false)",
            "the links' parameters take a rotor; not noticed: {}",
        ),
    ):
        unnoticed = [
            t
            for t in terms
            if t.kind == kind and not t.found and t.noticed > MAX_UNNOTICED.get(t.unit, 0.0)
        ]
        if unnoticed:
            joints = [t.where.removeprefix("of joint ") for t in unnoticed]
            sizes = (
                f"{t.noticed:.2g} {t.unit}" if np.isfinite(t.noticed) else "any" for t in unnoticed
            )
            each = ", ".join(
                f"up to {size} at {joint}" for size, joint in zip(sizes, joints, strict=True)
            )
            yield Assumed(
                f"{kind}s",
                value.format(", ".join(joints)),
                why.format(each.replace("up to any", "any")),
            )


def _rank(term: candidates.MissingTerm) -> tuple[float, float]:
    """Sort key. Several joints may lack the same term, so all columns of a kind count together.

    Asymmetric Coulomb friction contains an offset, so it wins a tie. A tilt of gravity follows the
    position, as springs do.
    """
    ahead = MAX_TIE_PERCENT if term.kind in (candidates.ASYMMETRIC, candidates.TILT) else 0.0
    return (
        0.5 if term.kind == candidates.SPRING else 1.0
    ) * term.together_percent + ahead, term.taken_percent


def missing_terms(evidence: FitData) -> tuple[candidates.MissingTerm, ...]:
    """All columns that are independent of W; and zeros and rotors in its span,
    which bias the parameters.

    Negative Stribeck friction is left out: near standstill, filters and elasticity smooth
        the sign of the speed.
    """
    places, joints = evidence.candidates[0].places
    acts, weight = joints.T[evidence.observed.system.joint_of_row], evidence.weight[:, None]
    C, rate = evidence.observed.C[:, places] * acts * weight, evidence.observed.C[:, -1:] * weight
    terms = _scored(evidence, evidence.candidates[0].terms, C)
    for k, term in terms.items():
        if term.kind == candidates.CLOCKS or (
            term.kind == candidates.LAG and abs(term.t) > candidates.MIN_T
        ):
            # In fast rows only: friction near reversals looks like a lag. And beside the common
            # lag, which its prior holds.
            among = (
                evidence.observed.fast | ~acts[:, k],
                rate if term.kind == candidates.CLOCKS else rate[:, :0],
            )
            again = _scored(evidence, [term], C[:, [k]], among).get(0, replace(term, t=0.0))
            terms[k] = (
                again
                if term.kind == candidates.CLOCKS or again.t * term.t > 0
                else replace(term, t=0.0)
            )
    together = dict[str, float]()
    for kind in {term.kind for term in terms.values()} - {candidates.CLOCKS}:
        own = C[
            :, [k for k, term in terms.items() if term.kind == kind and np.isfinite(term.noticed)]
        ]
        z, apart = _projected(own, evidence.W, evidence.estimate.Q, evidence.estimate.bread)
        left = evidence.rho - apart @ np.linalg.lstsq(z.T @ own, z.T @ evidence.rho, rcond=1e-6)[0]
        together[kind] = 100 * (
            1 - float(left @ left) / max(float(evidence.rho @ evidence.rho), 1e-300)
        )
    return tuple(
        replace(term, together_percent=together.get(term.kind, term.taken_percent))
        for term in terms.values()
        if term.kind != candidates.STRIBECK or term.value > 0
    )


def _projected(C: Array, W: Array, Q: Array, bread: Array) -> tuple[Array, Array]:
    """Columns C (r, k) made orthogonal to W by the span of Q, and what is left of them
    when beta is solved again.
    """
    return C - Q @ (bread.T @ (W.T @ C)), C - W @ (bread @ (Q.T @ C))


def _scored(
    evidence: FitData,
    terms: Sequence[candidates.MissingTerm],
    C: Array,
    among: tuple[NDArray[np.bool_], Array] | None = None,
) -> dict[int, candidates.MissingTerm]:
    """Terms of columns C (r, k) by their places with their figures, `among` some of the rows
    (r,), and further columns.
    """
    W, Q, bread, rho = evidence.W, evidence.estimate.Q, evidence.estimate.bread, evidence.rho
    if among:
        rows, beside = among
        W, Q, C = (
            np.c_[W, beside] * rows[:, None],
            np.linalg.qr(np.c_[Q, beside] * rows[:, None])[0],
            C * rows[:, None],
        )
        bread = np.linalg.pinv(Q.T @ W, rcond=1e-12)
        rho = rows * evidence.Y - W @ (bread @ (Q.T @ evidence.Y))
    z, apart = _projected(C, W, Q, bread)
    norm, left = np.linalg.norm(C, axis=0), np.linalg.norm(z, axis=0)
    independent = (left > MIN_INDEPENDENT_NORM * norm) & (norm > 0)
    # A zero may act nowhere, and a rotor in the span to rounding is a part of a link's parameter.
    stays = {
        candidates.ZERO: norm > MIN_BIAS * np.linalg.norm(evidence.Y),
        candidates.ROTOR: left > MIN_BIAS * norm,
    }
    size = np.where(independent, np.einsum("rk,rk->k", z, C), np.inf)
    g = z.T @ rho / size
    with_term = rho[:, None] - g * apart  # and beta solved again
    whole = max(float(rho @ rho), 1e-300)
    sigma = deviations_of_sums(evidence.observed.system, z, with_term, Q) / np.abs(size)
    counts = np.array([name in evidence.essential for name in evidence.estimate.names])
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = (bread @ (Q.T @ C))[: len(counts)] * g
        moves = np.nan_to_num(np.abs(moved) / evidence.intervals.half[:, None]) * counts[:, None]
        t = np.where(sigma > 0, g / sigma, 0.0)
        large = np.sqrt(0.01 * candidates.MIN_TAKEN_PERCENT * whole) / np.linalg.norm(apart, axis=0)
        seen = np.maximum((candidates.MIN_T + MARGIN_T) * sigma, large)
    taken = 100 * (1 - np.einsum("rk,rk->k", with_term, with_term) / whole)
    noticed = np.where(independent, seen, np.inf)
    names = ("value", "t", "taken_percent", "moves", "noticed")
    figures = np.transpose([g, t, taken, moves.max(axis=0), noticed]).tolist()
    every = (
        replace(term, **dict(zip(names, of, strict=True)))
        for term, of in zip(terms, figures, strict=True)
    )
    return {k: term for k, term in enumerate(every) if stays.get(term.kind, independent)[k]}
