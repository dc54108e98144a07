"""Cross-validation: each block of time of one recording, or each of several recordings, predicted
by a fit of the others.

The rows of a part are those of its spans of time, R factors of which have the same products. The
others may leave parameters undetermined.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from ..arrays import Array
from ..estimation import undetermined_parameters
from .evidence import FitData, HeldOut, TrustLine, figures_of, first_case

NAME = "held-out blocks"
BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error, in weighted rows

# decimated torque (rows, n) by estimates, in as many equal spans of each recording
Predict = Callable[..., Array]


def held_out(evidence: FitData, predict: Predict) -> tuple[TrustLine | None, tuple[HeldOut, ...]]:
    """Five blocks of time of one recording, or each of several, predicted by the fit of the others;
    a recording's own parameters are fitted to it, as the others do not contain them. The line, and
    the errors of recordings.

    With drive gains the blocks are of each recording: none alone determines them. Errors in percent
    are of the torque; where the model does not hold, joints stand: those of weighted rows leave
    that out.
    """
    rows, estimate, b = evidence.observed, evidence.estimate, len(evidence.estimate.beta)
    several = len(evidence.names) > 1 and not evidence.gains
    own = [arm.own for arm in evidence.arms] if several else [set[str]()] * BLOCKS
    names = evidence.names if several else [f"block {k + 1}" for k in range(BLOCKS)]
    recordings = [evidence.between(*both) for both in pairwise(evidence.ends)]
    parts = recordings if several else evidence.spans(BLOCKS)
    numbers = [evidence.count(part) for part in parts]
    if not several and sum(numbers) - max(numbers) <= b:
        why = f"not made: too few rows outside a block for {b} parameters; record longer"
        return TrustLine(NAME, "not made", why), ()
    by_others = predictions_by_others([*map(evidence.factor, parts)], estimate.names, own)
    lost = [one if several else [] for _, one in by_others]
    betas = [estimate.beta if its else beta for its, (beta, _) in zip(lost, by_others, strict=True)]
    predicted = predict(*(replace(estimate, beta=x) for x in betas), by_recording=several)
    measured = np.concatenate([x.measured_rows() for x in evidence.problems])
    errors, each = (rows.tau, rows.tau - predicted, rows.tau - evidence.predicted), list[HeldOut]()
    made, norms, without = list[str](), list[list[float]](), list[str]()
    for name, part, beta, its in zip(names, parts, betas, lost, strict=True):
        at = (rows.share > 0) & (measured & evidence.instants(part))[:, None]
        torque, *both = (float(np.linalg.norm(x[at])) for x in errors)
        if torque > 0 and not its:
            made.append(name)
            weighted = (evidence.error(part, x) for x in (beta, estimate.beta))
            norms.append([torque, *both, *weighted])
        elif several:
            why = f"{', '.join(its[:8])} undetermined" if its else "it has no torque"
            without.append(f"{name} cannot be predicted by the others: {why}")
        if several:
            held, trained = (100 * x / torque if torque > 0 else None for x in both)
            each.append(HeldOut(None if its else held, trained, tuple(its)))
    if not made:
        text = "; ".join(without) or "not made: no torque"
        return TrustLine(NAME, "cannot tell" if several else "not made", text), tuple(each)
    return _line(evidence, made, np.array(norms), without, several=several), tuple(each)


def _line(
    evidence: FitData, names: list[str], norms: Array, without: list[str], *, several: bool
) -> TrustLine | None:
    """The line of parts, by the norms (k, 5) of their torque, its errors held out and trained, and
    those of weighted rows; `without` tells of the other parts.
    """
    torque, error, training, held, trained = np.linalg.norm(norms, axis=0)
    percents = 100 * norms[:, 1:3] / norms[:, :1]
    error, training = 100 * error / torque, 100 * training / torque
    text = f"error {error:.3g} %{' of recordings' * several} held out, {training:.3g} % trained"
    text, ratio = "; ".join([text, *without]), held / max(trained, 1e-300)
    more = (
        f"{text}: the fit does not generalise ({ratio:.2g} times where joints move): "
        f"record {'more' if several else 'longer'}, with more varied motion, or fit with "
        "--essential"
        + ", or take the parameters of --consistent, which generalise better"
        * evidence.robot.gain_known
    )
    return first_case(
        NAME,
        (trained > 0 and ratio > MAX_HELD_OUT_RATIO, "caution", more, "does not generalise"),
        (True, "ok", text),
        value=float(error),
        figures=figures_of(names, percents[:, 0], 0 * percents[:, 0], percents[:, 1]),
        unit="%",
        fails_held_out=bool(trained > 0 and ratio > MAX_HELD_OUT_RATIO_NOT_POSITIVE),
    )


def predictions_by_others(
    factors: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array, list[str]]]:
    """Parameters (b,) to predict each part by the fit of the others, its `own` ones fitted to it,
    from R factors of weighted rows [Z W Y]; and the names of those that the others do not
    determine.
    """
    found = list[tuple[Array, list[str]]]()
    size = np.linalg.norm(np.concatenate(factors)[:, len(names) : -1], axis=0)
    for k, its in enumerate(own):
        alone = np.array([name in its for name in names])
        others = np.concatenate([*factors[:k], *factors[k + 1 :]])[:, ~np.r_[alone, alone, False]]
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
