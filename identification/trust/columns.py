"""Tests for terms that the model may lack, by columns added to W one by one.

Each column has the share of the residual that it explains.

The model is Y = W beta + rho, solved with instruments whose orthonormal span is Q, beta = B QᵀY
with the bread B = (QᵀW)⁻¹. A column c beside W, its own instrument, has the coefficient

    g = zᵀrho / zᵀc,    z = c - Q Bᵀ Wᵀc,

where z is c made orthogonal to W by the span Q. So no system is solved again: beta moves by -g B
Qᵀc, and the residual becomes rho - g (c - W B Qᵀc). With instruments, c is the column of the
simulated motion, so that position noise does not bias g. Columns have the weights of W.

The deviation of g is that of the scores z rho' / zᵀc by equal-weighted cosines, where rho' is the
residual with the column, divided by the share that estimate and column leave of white noise: a slow
column removes much of the low frequencies. A term is found if its g is many deviations and takes
enough of the residual's square. All columns of a kind are also solved together: joints that lack
the same term make each other's column look weak. A column in the span of W has no g, but a zero or
a rotor there still biases beta; it is kept, to be listed among the assumptions.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import compress, groupby

import numpy as np

from ..arrays import Array, Bools
from ..estimation import Estimate, deviations_of_sums, orthonormal, release_memory
from ..report import Assumed, TrustResult
from . import kinds
from .candidates import MIN_T, MissingTerm
from .evidence import Case, TrustInputs, Words, assume

AHEAD = (kinds.ASYMMETRIC, kinds.TILT, kinds.RATIO)
MAX_TIE_PERCENT = 2.0  # of the residual's square: kinds within this are indistinguishable
# Below this share of its norm outside the span of W, the coefficient of a column is too uncertain
# to be usable.
MIN_INDEPENDENT_NORM = 0.01
# Below this share, of its norm or of that of the torque, a column is rounding and cannot bias
# anything.
MIN_BIAS = 1e-6
MARGIN_T = 2.0  # deviations above MIN_T, at which nearly every recording shows it
# The share of a kind is reduced for its rank, because any slow error resembles a spring, and
# because many columns explain more than one does.
SHARES = {kinds.SPRING: 0.5, kinds.CURVED: 0.5, kinds.HYSTERESIS: 0.5, kinds.IN_PARTS: 0.8}
MIN_RIVAL = 0.8  # of what the first kind takes: another that takes as much may be the cause too
# A zero error that goes unnoticed up to this size is harmless; above it becomes an assumption.
MAX_UNNOTICED = {"deg": 2.0, "mm": 10.0}


def added_columns_test(evidence: TrustInputs) -> TrustResult | None:
    """Test for terms that the model may lack.

    These are friction, a rotor, an offset, a spring, base tilt, a joint zero offset, a gain, a
    delay, or clock drift. Each term's column is added to the regressor in turn (an added-variable
    test).
    """
    every, robot = missing_terms(evidence), evidence.robot
    terms = [term for term in every if np.isfinite(term.noticed)]
    found = [term for term in terms if term.found]
    first = max(found, key=_rank) if found else max(terms or every, key=lambda x: abs(x.t))
    # Name a second kind at the same joint if it explains as much, because the data cannot decide
    # between the two.
    rivals = (
        x
        for x in found
        if x.kind != first.kind
        and x.where == first.where
        and x.together_percent > MIN_RIVAL * first.together_percent
    )
    told = [first, *rivals][:2]
    # A rotor inertia, once allowed, absorbs what another kind explains, so it comes last.
    told.sort(key=lambda x: x.kind == kinds.ROTOR)
    each = [
        x.finding if x is not told[0] and x.kind == kinds.ROTOR else f"{x.finding}: {x.advice}"
        for x in told
    ]
    each[0] = told[0].advice if told[0] is first else each[0]
    return ADDED_COLUMNS.judge(
        {"every term": not terms, "missing": found, "ok": True},
        value=first.t if terms else None,
        assumed=tuple(_assumed(every)),
        coefficient=f"{first.kind} {first.where} ({f'{first.value:.3g} {first.unit}'.rstrip()})",
        t=first.t,
        taken=first.taken_percent,
        more=len(found) > 1,
        others=len(found) - 1,
        limit=MIN_T,
        each=" or, as it explains as much, ".join(each),
        finding=", or ".join(x.finding for x in told),
        tried=len(terms),
        lone=robot.n == 1,
        units=robot.n > 1 and not robot.gain_known,
    )


ADDED_COLUMNS = Words(
    test="missing terms",
    place=160,
    by=added_columns_test,
    advice="Describe it (`friction`, `offset`, `gravity_m_s2`), record it "
    "([`known_torque`](../../acquisition/docs/import.md#maptoml)), or remove its cause.",
    detects="A term that the model lacks (added-variable test): friction terms, offset, drift, "
    "springs, an effort limit, a disabled rotor inertia, base tilt, joint zero offsets, gain, "
    "ratio or delay of one joint, clock drift, hysteresis. A term that explains as much at the "
    "same joint is named too",
    limit="`caution`: t is above 5, and the term explains more than 2 % of the residual variance "
    "(10 % for a lone spring or friction of a part of the time). A delay counts if it changes "
    "an essential parameter by more than one half-width",
    cases={
        "every term": Case("skipped", "the model has every term that is tried"),
        "missing": Case("caution", "{strongest}{more}", "{each}.", "{finding}"),
        "ok": Case("ok", "none found of {tried} tried; the strongest, {strongest}{lone}{units}"),
    },
    parts={
        "strongest": "{coefficient} would explain {taken:.1f} % of the residual variance "
        "(t = {t:.1f})",
        "more": "; {others} more with t above {limit:g}",
        "lone": "; one joint has no relative gain",
        "units": "; relative gains not tried, because the drive gains are not known",
    },
)


def _assumed(terms: Sequence[MissingTerm]) -> Iterator[Assumed]:
    """List zeros whose large error goes unnoticed, and disabled rotor inertias."""
    for kind, what in ((kinds.ZERO, "joint zeros"), (kinds.ROTOR, "rotor inertias")):
        unnoticed = {
            t.where.removeprefix("of joint "): f"up to {t.noticed:.2g} {t.unit}"
            if np.isfinite(t.noticed)
            else "any"
            for t in terms
            if t.kind == kind and not t.found and t.noticed > MAX_UNNOTICED.get(t.unit, 0.0)
        }
        if unnoticed:
            yield assume(
                what,
                joints=", ".join(unnoticed),
                each=", ".join(f"{size} at {joint}" for joint, size in unnoticed.items()),
            )


def _rank(term: MissingTerm) -> tuple[float, float]:
    """Return the sort key of a term.

    All columns of a kind count together, since several joints may lack the same term. Asymmetric
    Coulomb friction contains an offset, so it wins a tie. Base tilt follows the position, as
    springs do. A wrong ratio resembles a rotor inertia, and can be checked.
    """
    together = SHARES.get(term.kind, 1.0) * term.together_percent
    return together + MAX_TIE_PERCENT * (term.kind in AHEAD), term.taken_percent


def missing_terms(evidence: TrustInputs) -> tuple[MissingTerm, ...]:
    """Return all terms whose columns are independent of W, and the zeros and rotors in its span.

    The latter bias the parameters. Negative Stribeck friction is left out: near standstill, filters
    and elasticity smooth the sign of the speed. Negative rotor inertias do not exist.
    """
    found, asked = list[MissingTerm](), evidence.candidates.terms
    release_memory(evidence.observed.C)
    # Terms of parts of the time are compared joint by joint, because they must be distinguished.
    for (kind, _), of in groupby(
        asked, lambda x: (x.kind, x.joint if x.kind == kinds.IN_PARTS else None)
    ):
        terms = _scored(evidence, kind, list(of), fast=kind == kinds.CLOCKS)
        found += [x for x in terms if kind not in kinds.POSITIVE or x.value > 0 or not x.found]
    for i, term in enumerate(found):
        if term.kind == kinds.LAG and abs(term.t) > MIN_T:
            # In fast rows only: friction near reversals looks like a lag.
            again = _scored(evidence, term.kind, [term], fast=True)
            told = next((x for x in again if x.t * term.t > 0), replace(term, t=0.0))
            found[i] = replace(told, together_percent=term.together_percent)
    return tuple(found)


def _scored(
    evidence: TrustInputs, kind: str, terms: Sequence[MissingTerm], *, fast: bool
) -> list[MissingTerm]:
    """Return the terms of a kind with their figures.

    `fast`: for a single term, use the rows of its joint in which a delay shows, and estimate clock
    drift beside the common delay, which its prior holds.
    """
    own = np.array([-1 if term.joint is None else term.joint for term in terms])
    acts = (evidence.observed.system.joint_of_row[:, None] == own) | (own < 0)
    C = _columns(evidence, terms) * evidence.weight[:, None]
    C *= acts & (evidence.observed.fast[:, None] | (kind not in kinds.IN_FAST_ROWS))
    whole = evidence.estimate, evidence.W, np.ones(1)
    fit, W, rows = _by_fast_rows(evidence, kind, acts[:, 0]) if fast else whole
    rho = rows * (evidence.Y - W @ fit.beta)
    by_column = fit.bread @ (fit.Q.T @ C)  # beta solved again
    z, apart = C - fit.Q @ (fit.bread.T @ (W.T @ C)), (C - W @ by_column) * rows[:, None]
    independent, stays = _usable(evidence, kind, C, z)
    size = np.where(independent, (z * C).sum(axis=0), np.inf)
    g = z.T @ rho / size
    some = z[:, independent]
    of_all = np.linalg.lstsq(some.T @ C[:, independent], some.T @ rho, rcond=1e-6)[0]
    with_term, with_all = rho[:, None] - g * apart, rho - apart[:, independent] @ of_all
    noise, common = with_term, None
    if kind == kinds.IN_PARTS:  # the others would count as noise; the last is less their sum
        some = some[:, :-1]
        noise, common = with_all[:, None], orthonormal(some - fit.Q @ (fit.Q.T @ some))
    sigma = deviations_of_sums(evidence.observed.system, z, noise, fit.Q, common) / np.abs(size)
    figures = {
        "value": g,
        "t": np.divide(g, sigma, out=np.zeros_like(g), where=sigma > 0),
        "taken_percent": _taken_percent(rho, with_term),
        "together_percent": np.full_like(g, _taken_percent(rho, with_all)),
        "moves": _moves(evidence, by_column * g),
        "noticed": np.where(independent, _noticed(rho, apart, sigma), np.inf),
    }
    each = zip(terms, np.transpose([*figures.values()]).tolist(), strict=True)
    return [
        replace(term, **dict(zip(figures, of_term, strict=True)))
        for term, of_term in compress(each, stays)
    ]


def _by_fast_rows(evidence: TrustInputs, kind: str, acts: Bools) -> tuple[Estimate, Array, Array]:
    """Return the estimate, its W, and the weights (r,), 0 or 1, of the rows.

    Slow rows in which a term acts have zero weight. Clock drift gets a column for the common delay.
    """
    rows = (evidence.observed.fast | ~acts).astype(float)  # so that no product is a further copy
    lag = evidence.observed.L[:, -len(evidence.lags) :].sum(axis=1, keepdims=True)
    lag = lag[:, : int(kind == kinds.CLOCKS)] * -evidence.weight[:, None]
    W, Q = np.c_[evidence.W, lag] if lag.size else evidence.W, np.c_[evidence.estimate.Q, lag]
    Q *= rows[:, None]  # in place: a copy fewer of a long recording
    Q = orthonormal(Q)
    bread = np.linalg.pinv(Q.T @ W, rcond=1e-12).astype(float)
    fit = replace(evidence.estimate, Q=Q, bread=bread, beta=bread @ (Q.T @ evidence.Y))
    return fit, W, rows


def _usable(evidence: TrustInputs, kind: str, C: Array, z: Array) -> tuple[Bools, Bools]:
    """Select the columns that are independent of W, and the terms to keep.

    A zero that acts at all is kept. So is a rotor that lies in the span of W up to rounding,
    because it is part of a link parameter.
    """
    norm, left = np.linalg.norm(C, axis=0), np.linalg.norm(z, axis=0)
    independent = (left > MIN_INDEPENDENT_NORM * norm) & (norm > 0)
    if kind == kinds.ZERO:
        return independent, norm > MIN_BIAS * np.linalg.norm(evidence.Y)
    return independent, left > MIN_BIAS * norm if kind == kinds.ROTOR else independent


def _moves(evidence: TrustInputs, shifts: Array) -> Array:
    """Return the largest shifts (k,) of essential parameters, in half-widths.

    `shifts` (b, k) are those of beta.
    """
    counts = np.isin(evidence.estimate.names, evidence.essential)[:, None]
    within = np.where(counts, evidence.intervals.half[:, None], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(np.abs(shifts[: len(within)]) / within).max(axis=0))


def _noticed(rho: Array, apart: Array, sigma: Array) -> Array:
    """Return the sizes (k,) of coefficients that are worth a finding.

    These coefficients are significant and explain enough of the residual.
    """
    large = np.sqrt(0.01 * kinds.MIN_TAKEN_PERCENT) * np.linalg.norm(rho)
    with np.errstate(divide="ignore"):
        large = np.maximum(large, 1e-151) / np.linalg.norm(apart, axis=0)
    return np.asarray(np.maximum((MIN_T + MARGIN_T) * sigma, large))


def _columns(evidence: TrustInputs, terms: Sequence[MissingTerm]) -> Array:
    """Return the columns (r, k) of the terms of a kind: from C, or model torques by time block."""
    if terms[0].column >= 0:
        return evidence.observed.C[:, [term.column for term in terms]]
    kind, ends, middle = kinds.KINDS[terms[0].place[0]], evidence.ends, evidence.middles
    k = np.searchsorted(ends, middle) - 1
    u = (middle - ends[k]) / np.diff(ends)[k] - 0.5
    beta = np.where(
        [name.startswith(kind.of) for name in evidence.estimate.names], evidence.estimate.beta, 0.0
    )
    of_spans = np.stack([kind.in_time(u, term.place[1]) for term in terms], axis=1)
    return (evidence.Z[:, evidence.places] @ beta)[:, None] * of_spans[
        evidence.observed.system.span
    ]


def _taken_percent(rho: Array, left: Array) -> Array:
    """Return the share of |rho|² that the remainder no longer has, in percent.

    The remainder `left` is (r,) or (r, k).
    """
    return np.asarray(100 * (1 - (left**2).sum(axis=0) / max(float(rho @ rho), 1e-300)))
