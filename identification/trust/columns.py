"""Terms that the model may lack: columns added to W one by one, each with the share of the residual that it explains.

With z = c - Q (QᵀW)⁻ᵀ Wᵀc, a column c made orthogonal to W by the instruments' span Q, its coefficient is g = zᵀrho / zᵀc.
Its deviation is that of the scores z rho' / zᵀc by equal-weighted cosines, where rho' is the residual with the column, divided
by the share that estimate and column leave of white noise: a slow column removes much of the low frequencies. With instruments,
c is the column of the simulated motion, so that position noise does not bias g. Columns have the weights of W.
"""

from dataclasses import replace

import numpy as np

from ..estimation import deviations_of_sums
from .candidates import ASYMMETRIC, DRIFT, LAG, MIN_T, SPRING, STRIBECK, TILT, MissingTerm
from .fit_data import FitData
from .lines import TrustLine

MAX_TIE_PERCENT = 2.0  # of the residual's square: kinds within this are indistinguishable
MIN_INDEPENDENT_NORM = 0.01  # share of a column's norm outside the span of W, for a usable coefficient


def added_columns_test(evidence: FitData) -> TrustLine:
    """Whether the model lacks a term: friction, an offset, drift, a spring, a tilt of gravity, a gain or a lag."""
    name = "added columns"
    terms = missing_terms(evidence)
    if not terms:
        return TrustLine(name, "not made", "not made: the model has every term that is tried")
    found = [term for term in terms if term.found]
    first = max(found or terms, key=_rank)
    strongest = f"{first.kind} {first.where} {first.value:.3g} {first.unit}".rstrip()
    strongest += f", t = {first.t:.1f}, {first.taken_percent:.1f} % of the residual"
    if not found:
        robot = evidence.problem.signals.robot
        untried = "" if robot.gain_known else "; relative gains not tried: the drive gains are not known"
        untried = "; one joint has no relative gain" if robot.n == 1 else untried
        text = f"no missing term found ({len(terms)} tried; strongest: {strongest}){untried}"
        return TrustLine(name, "ok", text, first.t)
    more = f"; {len(found) - 1} more with t above {MIN_T:g}" if len(found) > 1 else ""
    finding = f"{first.kind} {first.where}{'' if first.kind in (TILT, LAG, DRIFT) else ' missing'}"
    return TrustLine(name, "caution", f"{strongest}{more}: {first.advice}", first.t, finding=finding)


def _rank(term: MissingTerm) -> tuple[float, float]:
    """Sort key. Several joints may lack the same term, so all columns of a kind count together.

    Asymmetric Coulomb friction contains an offset, so it wins a tie. A tilt of gravity follows the position, as springs do.
    """
    ahead = MAX_TIE_PERCENT if term.kind in (ASYMMETRIC, TILT) else 0.0
    behind = 0.5 if term.kind == SPRING else 1.0
    return behind * term.together_percent + ahead, term.taken_percent


def missing_terms(evidence: FitData) -> tuple[MissingTerm, ...]:
    """All columns that are independent of W.

    Negative Stribeck friction is left out: near standstill, filters and elasticity smooth the sign of the speed.
    """
    terms, n = evidence.candidates[0].terms, evidence.observed.tau.shape[1]
    W, rho, Q, bread = evidence.W, evidence.rho, evidence.estimate.Q, evidence.estimate.bread
    places, joints = evidence.candidates[0].places
    C = evidence.observed.C[:, places] * joints.T[evidence.observed.system.joint_of_row] * evidence.weight[:, None]
    z = C - Q @ (bread.T @ (W.T @ C))  # zᵀW = 0
    independent = np.linalg.norm(z, axis=0) > MIN_INDEPENDENT_NORM * np.linalg.norm(C, axis=0)
    independent &= np.linalg.norm(C, axis=0) > 0
    C, z = C[:, independent], z[:, independent]
    columns = [term for term, keep in zip(terms, independent, strict=True) if keep]
    size = np.einsum("rk,rk->k", z, C)
    g = z.T @ rho / size
    with_term = rho[:, None] - g * (C - W @ (bread @ (Q.T @ C)))  # and beta solved again
    sigma = deviations_of_sums(z, with_term, Q, n, evidence.observed.system.spans) / np.abs(size)
    whole = max(float(rho @ rho), 1e-300)
    counts = np.array([name in evidence.essential for name in evidence.estimate.names])
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.nan_to_num(np.abs(bread @ (Q.T @ C) * g) / evidence.intervals.half[:, None]) * counts[:, None]
    taken = 100 * (1 - np.einsum("rk,rk->k", with_term, with_term) / whole)
    together = {}
    for kind in {column.kind for column in columns}:
        own = np.array([column.kind == kind for column in columns])
        apart = C[:, own] - W @ (bread @ (Q.T @ C[:, own]))
        left = rho - apart @ np.linalg.lstsq(z[:, own].T @ C[:, own], z[:, own].T @ rho, rcond=1e-6)[0]
        together[kind] = 100 * (1 - float(left @ left) / whole)
    return tuple(
        replace(
            column,
            value=float(value),
            t=float(value / s) if s > 0 else 0.0,
            taken_percent=float(percent),
            together_percent=together[column.kind],
            moves=float(moves),
        )
        for column, value, s, percent, moves in zip(columns, g, sigma, taken, moved.max(axis=0), strict=True)
        if column.kind != STRIBECK or value > 0
    )
