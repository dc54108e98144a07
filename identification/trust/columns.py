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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import deviations_of_sums, orthonormal
from ..report import Assumed
from . import candidates
from .fit_data import FitData
from .lines import TrustLine, first_case

MAX_TIE_PERCENT = 2.0  # of the residual's square: kinds within this are indistinguishable
# share of a column's norm outside the span of W, for a usable coefficient
MIN_INDEPENDENT_NORM = 0.01
# the same, and of a column's norm beside the torque's: below, it is rounding and biases nothing
MIN_BIAS = 1e-6
MAX_NUMBERS = 1_000_000  # of columns that are tried at a time: 8 MB, a few times as much in all
MARGIN_T = 2.0  # deviations above MIN_T, at which nearly every recording shows it
# error of a zero; a larger one that is not noticed is assumed away
MAX_UNNOTICED = {"deg": 2.0, "mm": 10.0}
ASSUMED = (
    (candidates.ZERO, "right at {}", "a wrong zero turns the links' parameters"),
    (
        candidates.ROTOR,
        "none at {} (rotor_inertia = false)",
        "the links' parameters take a rotor",
    ),
)


def added_columns_test(evidence: FitData) -> TrustLine | None:
    """Whether the model lacks a term: friction, a rotor, an offset, a spring, a tilt, a zero,
    a gain, a lag, clocks.
    """
    every, robot = missing_terms(evidence), evidence.robot
    assumed, terms = tuple(_assumed(every)), [term for term in every if np.isfinite(term.noticed)]
    found = [term for term in terms if term.found]
    first = max(found or terms or every, key=_rank)
    strongest = f"{first.kind} {first.where} {first.value:.3g} {first.unit}".rstrip()
    strongest += f", t = {first.t:.1f}, {first.taken_percent:.1f} % of the residual"
    untried = (
        "; one joint has no relative gain"
        if robot.n == 1
        else "; relative gains not tried: the drive gains are not known"
        if not robot.gain_known
        else ""
    )
    more = f"; {len(found) - 1} more with t above {candidates.MIN_T:g}" if len(found) > 1 else ""
    none = f"no missing term found ({len(terms)} tried; strongest: {strongest}){untried}"
    return first_case(
        "added columns",
        (not terms, "not made", "not made: the model has every term that is tried"),
        (found, "caution", f"{strongest}{more}: {first.advice}", first.finding),
        (True, "ok", none),
        value=first.t if terms else None,
        assumed=assumed,
    )


def _assumed(terms: Sequence[candidates.MissingTerm]) -> Iterator[Assumed]:
    """Zeros whose large error is not noticed, and rotors that the description denies."""
    for kind, value, why in ASSUMED:
        unnoticed = [
            (
                f"up to {t.noticed:.2g} {t.unit}" if np.isfinite(t.noticed) else "any",
                t.where.removeprefix("of joint "),
            )
            for t in terms
            if t.kind == kind and not t.found and t.noticed > MAX_UNNOTICED.get(t.unit, 0.0)
        ]
        if unnoticed:
            each = ", ".join(f"{size} at {joint}" for size, joint in unnoticed)
            joints = ", ".join(joint for _, joint in unnoticed)
            yield Assumed(f"{kind}s", value.format(joints), f"{why}; not noticed: {each}")


def _rank(term: candidates.MissingTerm) -> tuple[float, float]:
    """Sort key. Several joints may lack the same term, so all columns of a kind count together.

    Asymmetric Coulomb friction contains an offset, so it wins a tie. A tilt of gravity follows the
    position, as springs do.
    """
    ahead = MAX_TIE_PERCENT if term.kind in (candidates.ASYMMETRIC, candidates.TILT) else 0.0
    share = 0.5 if term.kind == candidates.SPRING else 1.0
    return share * term.together_percent + ahead, term.taken_percent


def missing_terms(evidence: FitData) -> tuple[candidates.MissingTerm, ...]:
    """All columns that are independent of W; and zeros and rotors in its span,
    which bias the parameters.

    Negative Stribeck friction is left out: near standstill, filters and elasticity smooth
        the sign of the speed.
    """
    observed, (places, joints) = evidence.observed, evidence.candidates[0].places
    acts, weight = joints.T[observed.system.joint_of_row], evidence.weight[:, None]
    tried, lags = evidence.candidates[0].terms, observed.L.shape[1] - len(evidence.lags)
    everywhere = np.array([term.kind not in candidates.IN_FAST_ROWS for term in tried])

    def columns(at: NDArray[np.intp]) -> Array:
        counts = acts[:, at] & (observed.fast[:, None] | everywhere[at])
        return np.asarray(observed.C[:, places[at]] * counts * weight)

    rate = -observed.L[:, lags:].sum(axis=1, keepdims=True) * weight
    terms, together = (
        {
            int(at[i]): term
            for at in np.array_split(np.arange(len(tried)), 1 + acts.size // MAX_NUMBERS)
            if len(at) or not tried
            for i, term in _scored(evidence, [tried[k] for k in at], columns(at)).items()
        },
        dict[str, float](),
    )
    for k, term in terms.items():
        clocks, none = term.kind == candidates.CLOCKS, replace(term, t=0.0)
        if clocks or (term.kind == candidates.LAG and abs(term.t) > candidates.MIN_T):
            # In fast rows only: friction near reversals looks like a lag. And beside the common
            # lag, which its prior holds.
            among = observed.fast | ~acts[:, k], rate[:, : int(clocks)]
            again = _scored(evidence, [term], columns(np.array([k])), among).get(0, none)
            terms[k] = again if clocks or again.t * term.t > 0 else none
    fit = _fit(evidence)
    for kind in {term.kind for term in terms.values()} - {candidates.CLOCKS}:
        own = [k for k, x in terms.items() if x.kind == kind and np.isfinite(x.noticed)]
        z, apart = fit.projected(C := columns(np.array(own, dtype=np.intp)))
        g = np.linalg.lstsq(z.T @ C, z.T @ fit.rho, rcond=1e-6)[0]
        together[kind] = float(fit.taken_percent(fit.rho - apart @ g))
    return tuple(
        replace(term, together_percent=together.get(term.kind, term.taken_percent))
        for term in terms.values()
        if term.kind != candidates.STRIBECK or term.value > 0
    )


class _Fit(NamedTuple):
    """Weighted columns W (r, b), the span Q of the instruments, bread, residuals rho (r,), and
    the rows (r, 1) that count.
    """

    W: Array
    Q: Array
    bread: Array
    rho: Array
    rows: Array

    def projected(self, C: Array) -> tuple[Array, Array]:
        """Columns C (r, k) made orthogonal to W by the span of Q, and what is left of them
        when beta is solved again.
        """
        along = self.Q @ (self.bread.T @ (self.W.T @ C))
        return C - along, (C - self.W @ (self.bread @ (self.Q.T @ C))) * self.rows

    def taken_percent(self, left: Array) -> Array:
        """Share of the square of rho that is not in what is left of it, (r,) or (r, k)."""
        whole = max(float(self.rho @ self.rho), 1e-300)
        return np.asarray(100 * (1 - (left**2).sum(axis=0) / whole))


def _fit(evidence: FitData, among: tuple[NDArray[np.bool_], Array] | None = None) -> _Fit:
    """The fit; or one `among` some of its rows (r,), with further columns."""
    estimate, W = evidence.estimate, evidence.W
    if among is None:
        return _Fit(
            W, estimate.Q, estimate.bread, evidence.residual(estimate.beta), np.ones((1, 1))
        )
    rows = among[0][:, None].astype(float)  # so that no product is a further copy
    Q = orthonormal(np.c_[estimate.Q, among[1]] * rows)
    W = np.c_[W, among[1]] if among[1].size else W
    bread: Array = np.linalg.pinv(Q.T @ W, rcond=1e-12).astype(float)
    return _Fit(W, Q, bread, rows[:, 0] * (evidence.Y - W @ (bread @ (Q.T @ evidence.Y))), rows)


def _scored(
    evidence: FitData,
    terms: Sequence[candidates.MissingTerm],
    C: Array,
    among: tuple[NDArray[np.bool_], Array] | None = None,
) -> dict[int, candidates.MissingTerm]:
    """Terms of columns C (r, k) by their places with their figures, `among` some of the rows
    (r,), and further columns.
    """
    fit, C = _fit(evidence, among), C * among[0][:, None] if among else C
    z, apart = fit.projected(C)
    norm, left = np.linalg.norm(C, axis=0), np.linalg.norm(z, axis=0)
    independent = (left > MIN_INDEPENDENT_NORM * norm) & (norm > 0)
    # A zero may act nowhere, and a rotor in the span to rounding is a part of a link's parameter.
    stays = {
        candidates.ZERO: norm > MIN_BIAS * np.linalg.norm(evidence.Y),
        candidates.ROTOR: left > MIN_BIAS * norm,
    }
    size = np.where(independent, (z * C).sum(axis=0), np.inf)
    g = z.T @ fit.rho / size
    with_term = fit.rho[:, None] - g * apart  # and beta solved again
    sigma = deviations_of_sums(evidence.observed.system, z, with_term, fit.Q) / np.abs(size)
    essential = np.isin(evidence.estimate.names, evidence.essential)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = (fit.bread @ (fit.Q.T @ C))[: len(essential)] * g
        moves = np.nan_to_num(np.abs(moved) / evidence.intervals.half[:, None])
        t = np.where(sigma > 0, g / sigma, 0.0)
        large = np.sqrt(0.01 * candidates.MIN_TAKEN_PERCENT) * np.linalg.norm(fit.rho)
        large = np.maximum(large, 1e-151) / np.linalg.norm(apart, axis=0)
    noticed = np.maximum((candidates.MIN_T + MARGIN_T) * sigma, large)
    moves, noticed = moves * essential[:, None], np.where(independent, noticed, np.inf)
    figures = np.stack([g, t, fit.taken_percent(with_term), moves.max(axis=0), noticed])
    return {
        k: replace(term, value=value, t=t, taken_percent=taken, moves=most, noticed=least)
        for k, (term, (value, t, taken, most, least)) in enumerate(
            zip(terms, figures.T.tolist(), strict=True)
        )
        if stays.get(term.kind, independent)[k]
    }
