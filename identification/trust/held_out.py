"""Cross-validation: each block of time of one recording, or each of several recordings, predicted
by a fit of the others.

A block adds A_k = Q_kᵀW_k and Q_kᵀY_k to A = QᵀW and QᵀY, so that the estimate of the others solves
(A - A_k) beta = QᵀY - Q_kᵀY_k. With several
recordings the others may leave parameters undetermined, so they are factored again.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import r_factor, relative_error_percent, spans_of, undetermined_parameters
from .fit_data import FitData
from .lines import Figure, HeldOut, TrustLine

BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error, in weighted rows

# decimated torque (rows, n) by estimates, in as many equal spans of each recording
Predict = Callable[..., Array]


def held_out_parts(evidence: FitData, predict: Predict) -> tuple[HeldOut, ...]:
    """Five blocks of time of one recording, or each of several, predicted by the fit of the others.

    With drive gains the blocks are of each recording: none alone determines them. Empty where too
    few rows are outside a block. Errors in percent are of the torque; where the model does not
    hold, joints stand: those of weighted rows leave that out.
    """
    if len(evidence.names) > 1 and not evidence.gains:
        return _recordings(evidence, predict)
    spans, estimate = evidence.spans(BLOCKS), evidence.estimate
    each = [(Q.T @ W, Q.T @ Y, rows) for Q, W, Y, rows in map(evidence.part, spans)]
    A, c, rows = (sum(x) for x in zip(*each, strict=True))
    if rows - max(own for _, _, own in each) <= len(estimate.beta):
        return ()
    d = np.linalg.norm(A, axis=0)
    betas = [np.linalg.lstsq((A - A_k) / d, c - c_k, rcond=1e-12)[0] / d for A_k, c_k, _ in each]
    by_others = predict(*(replace(estimate, beta=beta) for beta in betas))
    return tuple(
        _held_out(
            evidence,
            f"block {k}",
            evidence.instants(part),
            by_others,
            held=evidence.error(part, beta),
            trained=evidence.error(part, estimate.beta),
        )
        for k, (part, beta) in enumerate(zip(spans, betas, strict=True), 1)
    )


def _recordings(evidence: FitData, predict: Predict) -> tuple[HeldOut, ...]:
    """Each of several recordings; its own parameters are fitted to it, as the
    others do not contain them.
    """
    names, weights, estimate = evidence.estimate.names, evidence.estimate.weights, evidence.estimate
    parts = spans_of(evidence.observed.parts)
    rows = [_rows_of(evidence, k) for k in range(len(parts))]
    weighted = [np.c_[Z, W, Y] * weights[joint][:, None] for Z, W, Y, joint in rows]
    by_others = predictions_by_others(weighted, names, [arm.own for arm in evidence.arms])
    betas, found = (
        [estimate.beta if beta is None else beta for beta, _ in by_others],
        list[HeldOut](),
    )
    predicted = predict(*(replace(estimate, beta=beta) for beta in betas), by_recording=True)
    for k, (part, (_, W, Y, _), (beta, lost)) in enumerate(
        zip(parts, rows, by_others, strict=True)
    ):
        held, trained = (float(np.linalg.norm(Y - W @ x)) for x in (betas[k], estimate.beta))
        name, shown = evidence.names[k], None if beta is None else predicted
        found.append(
            _held_out(
                evidence, name, part, shown, held=held, trained=trained, undetermined=tuple(lost)
            )
        )
    return tuple(found)


def _held_out(
    evidence: FitData,
    name: str,
    part: slice | NDArray[np.bool_],
    predicted: Array | None,
    **known: Any,
) -> HeldOut:
    """With the torque errors of some instants, whose torque `predicted` (rows,
    n) the others predict.
    """
    tau, counts = (
        evidence.observed.tau[part],
        (
            evidence.observed.counts
            & np.concatenate([x.measured_rows() for x in evidence.problems])[:, None]
        )[part],
    )
    percents = [
        None if x is None else relative_error_percent(tau[counts], (tau - x[part])[counts])
        for x in (predicted, evidence.predicted)
    ]
    torque = float(np.linalg.norm(tau[counts]))
    return HeldOut(
        name=name, error_percent=percents[0], trained_percent=percents[1], torque=torque, **known
    )


def held_out_test(evidence: FitData) -> TrustLine:
    """Held-out and training error, in percent, of five blocks of time or of several recordings."""
    name, found = "held-out blocks", evidence.held_out
    several = len(evidence.names) > 1 and not evidence.gains
    if not found:
        b = len(evidence.estimate.beta)
        return TrustLine(
            name,
            "not made",
            f"not made: too few rows outside a block for {b} parameters; record longer",
        )
    made = [
        one for one in found if one.error_percent is not None and one.trained_percent is not None
    ]
    without = [
        f"{one.name} cannot be predicted by the others: "
        + (
            f"{', '.join(one.undetermined[:8])} undetermined"
            if one.undetermined
            else "it has no torque"
        )
        for one in found
        if one not in made and several
    ]
    if not made:
        return TrustLine(
            name,
            "cannot tell" if several else "not made",
            "; ".join(without) or "not made: no torque",
        )
    of_tau = np.array([[x.error_percent, x.trained_percent, 1.0] for x in made]) * np.array(
        [[x.torque] for x in made]
    )
    squares, of_weighted = (of_tau**2).sum(axis=0), np.array([[x.held, x.trained] for x in made])
    held, trained = (of_weighted**2).sum(axis=0)
    error, training = (float(np.sqrt(x / squares[2])) for x in squares[:2])
    text = "; ".join(
        [
            f"error {error:.3g} %{' of recordings' * several} held out, {training:.3g} % trained",
            *without,
        ]
    )
    figures = tuple(
        Figure(name=x.name, value=x.error_percent or 0.0, expected=x.trained_percent or 0.0)
        for x in made
    )
    ratio = float(np.sqrt(held / trained)) if trained > 0 else 1.0
    if ratio <= MAX_HELD_OUT_RATIO:
        return TrustLine(name, "ok", text, error, figures=figures, unit="%")
    advice = f"record {'more' if several else 'longer'}"
    text += f": the fit does not generalise ({ratio:.2g} times where joints move): {advice}"
    text += ", with more varied motion, or fit with --essential"
    if evidence.problem.signals.robot.gain_known:
        text += ", or take the parameters of --consistent, which generalise better"
    line = TrustLine(name, "caution", text, error, "does not generalise", figures=figures, unit="%")
    return replace(line, fails_held_out=ratio > MAX_HELD_OUT_RATIO_NOT_POSITIVE)


def predictions_by_others(
    parts: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array | None, list[str]]]:
    """Parameters (b,) to predict each part by the fit of the others, its `own` ones fitted to it,
    from weighted rows [Z W Y].

    Where the others do not determine them: None, and the names of those.
    """
    factors, found, b = (
        [r_factor(rows) for rows in parts],
        list[tuple[Array | None, list[str]]](),
        len(names),
    )
    for k, its in enumerate(own):
        alone = np.array([name in its for name in names])
        others = np.concatenate([R for i, R in enumerate(factors) if i != k])[
            :, ~np.r_[alone, alone, False]
        ]
        shared, undetermined = _solve(others, tuple(name for name in names if name not in its))
        beta = None
        if shared is not None:
            W, Y, beta = factors[k][:, b:-1], factors[k][:, -1], np.zeros(b)
            beta[~alone] = shared
            beta[alone] = np.linalg.lstsq(W[:, alone], Y - W @ beta)[0]
        found.append((beta, undetermined))
    return found


def _rows_of(evidence: FitData, k: int) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Z, W (r, b), Y (r,) and joints (r,) of recording k, of the estimated parameters."""
    system, names = evidence.observed.system, evidence.estimate.names
    indices, own = np.array([system.names.index(name) for name in names]), system.recording == k
    Z = system.W if evidence.Z is None else evidence.Z
    return (
        Z[np.ix_(own, indices)],
        system.W[np.ix_(own, indices)],
        system.Y[own],
        system.joint_of_row[own],
    )


def _solve(R: Array, names: tuple[str, ...]) -> tuple[Array | None, list[str]]:
    """Parameters (b,) from weighted rows [Z W Y], or the names of undetermined ones."""
    b = len(names)
    Z, W, Y = R[:, :b], R[:, b:-1], R[:, -1]
    if undetermined := undetermined_parameters(Z, names):
        return None, undetermined
    Q = np.linalg.qr(Z / np.linalg.norm(Z, axis=0))[0]
    A, d = Q.T @ W, np.linalg.norm(W, axis=0)
    if undetermined := undetermined_parameters(A, names):
        return None, undetermined
    return np.linalg.solve(A / d, Q.T @ Y) / d, []
