"""Cross-validation: each block of time of one recording, or each of several recordings, predicted
by a fit of the others.

The rows of a part are those of its spans of time, R factors of which have the same products. The
others may leave parameters undetermined.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace

import numpy as np

from ..arrays import Array
from ..estimation import r_factor, relative_error_percent, spans_of, undetermined_parameters
from .fit_data import FitData
from .lines import HeldOut, TrustLine, figures_of

BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error, in weighted rows

# decimated torque (rows, n) by estimates, in as many equal spans of each recording
Predict = Callable[..., Array]


def held_out_parts(evidence: FitData, predict: Predict) -> tuple[HeldOut, ...]:
    """Five blocks of time of one recording, or each of several, predicted by the fit of the others;
    a recording's own parameters are fitted to it, as the others do not contain them.

    With drive gains the blocks are of each recording: none alone determines them. Empty where too
    few rows are outside a block. Errors in percent are of the torque; where the model does not
    hold, joints stand: those of weighted rows leave that out.
    """
    rows, estimate, several = evidence.observed, evidence.estimate, _of_recordings(evidence)
    own = [arm.own for arm in evidence.arms] if several else [set[str]()] * BLOCKS
    names = evidence.names if several else [f"block {k + 1}" for k in range(BLOCKS)]
    whole = [evidence.between(one.start, one.stop) for one in spans_of(rows.parts)]
    parts = whole if several else evidence.spans(BLOCKS)
    numbers = [evidence.count(part) for part in parts]
    if not several and sum(numbers) - max(numbers) <= len(estimate.beta):
        return ()
    by_others = predictions_by_others([*map(evidence.factor, parts)], estimate.names, own)
    betas = [estimate.beta if several and lost else beta for beta, lost in by_others]
    predicted = predict(*(replace(estimate, beta=x) for x in betas), by_recording=several)
    measured = np.concatenate([x.measured_rows() for x in evidence.problems])
    counts = rows.counts & measured[:, None]
    found = list[HeldOut]()
    for name, part, beta, (_, lost) in zip(names, parts, betas, by_others, strict=True):
        at = counts & evidence.instants(part)[:, None]
        held, trained = (
            relative_error_percent(rows.tau[at], (rows.tau - tau)[at])
            for tau in (predicted, evidence.predicted)
        )
        found.append(
            HeldOut(
                name=name,
                error_percent=None if several and lost else held,
                trained_percent=trained,
                torque=float(np.linalg.norm(rows.tau[at])),
                held=evidence.error(part, beta),
                trained=evidence.error(part, estimate.beta),
                undetermined=tuple(lost),
            )
        )
    return tuple(found)


def _of_recordings(evidence: FitData) -> bool:
    """Whether recordings are held out, not blocks."""
    return len(evidence.names) > 1 and not evidence.gains


def held_out_test(evidence: FitData) -> TrustLine:
    """Held-out and training error, in percent, of five blocks of time or of several recordings."""
    name, several = "held-out blocks", _of_recordings(evidence)
    if not evidence.held_out:
        b = len(evidence.estimate.beta)
        why = f"not made: too few rows outside a block for {b} parameters; record longer"
        return TrustLine(name, "not made", why)
    made = [x for x in evidence.held_out if None not in (x.error_percent, x.trained_percent)]
    without = [
        f"{one.name} cannot be predicted by the others: "
        + (
            f"{', '.join(lost)} undetermined"
            if (lost := one.undetermined[:8])
            else "it has no torque"
        )
        for one in evidence.held_out
        if several and one not in made
    ]
    if not made:
        text = "; ".join(without) or "not made: no torque"
        return TrustLine(name, "cannot tell" if several else "not made", text)
    torque, held, trained = np.array([[x.torque, x.held, x.trained] for x in made]).T
    percents = np.array([[x.error_percent, x.trained_percent] for x in made], dtype=float).T
    error, training = np.linalg.norm(percents * torque, axis=1) / np.linalg.norm(torque)
    figures = figures_of([x.name for x in made], percents[0], 0 * torque, percents[1])
    text = f"error {error:.3g} %{' of recordings' * several} held out, {training:.3g} % trained"
    line = TrustLine(
        name, "ok", "; ".join([text, *without]), float(error), figures=figures, unit="%"
    )
    ratio = float(np.linalg.norm(held) / max(float(np.linalg.norm(trained)), 1e-300))
    if ratio <= MAX_HELD_OUT_RATIO or not trained.any():
        return line
    known = evidence.robot.gain_known
    return replace(
        line,
        level="caution",
        text=f"{line.text}: the fit does not generalise ({ratio:.2g} times where joints move): "
        f"record {'more' if several else 'longer'}, with more varied motion, or fit with "
        "--essential" + ", or take the parameters of --consistent, which generalise better" * known,
        finding="does not generalise",
        fails_held_out=ratio > MAX_HELD_OUT_RATIO_NOT_POSITIVE,
    )


def predictions_by_others(
    parts: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array, list[str]]]:
    """Parameters (b,) to predict each part by the fit of the others, its `own` ones fitted to it,
    from weighted rows [Z W Y]; and the names of those that the others do not determine.
    """
    factors, found = [r_factor(rows) for rows in parts], list[tuple[Array, list[str]]]()
    size = np.linalg.norm(np.concatenate(factors)[:, len(names) : -1], axis=0)
    for k, its in enumerate(own):
        alone = np.array([name in its for name in names])
        others = np.concatenate(factors[:k] + factors[k + 1 :])[:, ~np.r_[alone, alone, False]]
        shared, beta = tuple(name for name in names if name not in its), np.zeros(len(names))
        Z, W, Y = np.split(others, [len(shared), -1], axis=1)
        Q = np.linalg.qr(Z / np.maximum(np.linalg.norm(Z, axis=0), 1e-300))[0]
        A, d = Q.T @ W, size[~alone]
        lost = undetermined_parameters(Z, shared) or undetermined_parameters(A, shared)
        beta[~alone] = np.linalg.lstsq(A / d, Q.T @ Y[:, 0], rcond=1e-12)[0] / d
        _, W, Y = np.split(factors[k], [len(names), -1], axis=1)
        beta[alone] = np.linalg.lstsq(W[:, alone], Y[:, 0] - W @ beta)[0]
        found.append((beta, lost))
    return found
