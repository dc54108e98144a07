"""Cross-validation: each block of time of one recording, or each of several recordings, predicted by a fit of the others.

A block adds A_k = Q_kᵀW_k and Q_kᵀY_k to A = QᵀW and QᵀY, so that the estimate of the others solves
(A - A_k) beta = QᵀY - Q_kᵀY_k. Long recordings have these sums instead of rows. With several recordings the others may leave
parameters undetermined, so they are factored again.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..estimation import r_factor, spans_of, undetermined_parameters
from .fit_data import FitData, part_of
from .lines import Figure, TrustLine

BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """A recording predicted by the fit of the others, in the used rows.

    Attributes:
        error_percent: its torque error, in percent of its torque; None where the others do not determine the parameters.
        trained_percent: the same for the fit of all recordings.
        undetermined: names of the parameters that the others do not determine.
        torque: norm of its torque.
    """

    error_percent: float | None
    trained_percent: float | None
    undetermined: tuple[str, ...]
    torque: float


def held_out_test(evidence: FitData) -> TrustLine:
    """Held-out and training error, in percent, of five blocks of time or of several recordings."""
    name = "held-out blocks"
    if len(evidence.recordings) > 1 and not evidence.gains:
        return _recordings_line(evidence, held_out_recordings(evidence))
    estimate, sums = evidence.estimate, [evidence.sums(part) for part in evidence.spans(BLOCKS)]
    outside, b = sum(one.rows for one in sums) - max(one.rows for one in sums), len(estimate.beta)
    if outside <= b:
        text = f"not made: {outside} rows outside a block for {b} parameters; record longer"
        return TrustLine(name, "not made", text)
    A, c = sum(one.QW for one in sums), sum(one.QY for one in sums)
    d, squares, figures = np.linalg.norm(A, axis=0), np.zeros(3), []
    for number, one in enumerate(sums, 1):
        beta = np.linalg.lstsq((A - one.QW) / d, c - one.QY, rcond=1e-12)[0] / d
        own = np.array([one.error(beta - estimate.beta), one.rho_rho, one.tau_tau])
        squares += own
        if one.tau_tau > 0:
            held, trained = (float(x) for x in 100 * np.sqrt(own[:2] / one.tau_tau))
            figures.append(Figure(name=f"block {number}", value=held, expected=trained))
    if not squares[2] > 0:
        return TrustLine(name, "not made", "not made: no torque")
    error, training = (100 * float(np.sqrt(x / squares[2])) for x in squares[:2])
    text = f"error {error:.3g} % held out, {training:.3g} % trained"
    return _line(evidence, text, (error, training), "record longer", figures)


def held_out_recordings(evidence: FitData) -> tuple[HeldOut | None, ...]:
    """Each of several recordings predicted by the fit of the others; None for a single one.

    None also with drive gains, which no recording tells alone.

    Its own parameters are fitted to the recording itself, as the others do not contain them.
    """
    if len(evidence.recordings) == 1 or evidence.gains:
        return (None,) * len(evidence.recordings)
    names, weights = evidence.estimate.names, evidence.estimate.weights
    n, parts = evidence.observed.tau.shape[1], spans_of(evidence.observed.parts)
    rows = [_rows_of(evidence, k) for k in range(len(parts))]
    weighted = [np.c_[Z, W, Y] * weights[joint][:, None] for Z, W, Y, joint in rows]
    by_others = predictions_by_others(weighted, names, [one.parameters.own for one in evidence.recordings])
    found = []
    for k, ((_, W, Y, _), (beta, undetermined)) in enumerate(zip(rows, by_others, strict=True)):
        # Y is another torque, where W is linearised
        counts = part_of(evidence.used, n, parts[k]).reshape(n, -1).T
        torque = float(np.linalg.norm(evidence.observed.tau[parts[k]] * counts))
        trained = float(np.linalg.norm(Y - W @ evidence.estimate.beta))
        error_percent = None
        if beta is not None and torque > 0:
            error_percent = 100 * float(np.linalg.norm(Y - W @ beta)) / torque
        found.append(
            HeldOut(
                error_percent=error_percent,
                trained_percent=100 * trained / torque if torque > 0 else None,
                undetermined=tuple(undetermined),
                torque=torque,
            )
        )
    return tuple(found)


def predictions_by_others(
    parts: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array | None, list[str]]]:
    """Parameters (b,) to predict each part by the fit of the others, its `own` ones fitted to it, from weighted rows [Z W Y].

    Where the others do not determine them: None, and the names of those.
    """
    factors, found, b = [r_factor(rows) for rows in parts], list[tuple[Array | None, list[str]]](), len(names)
    for k, its in enumerate(own):
        alone = np.array([name in its for name in names])
        others = np.concatenate([R for i, R in enumerate(factors) if i != k])[:, ~np.r_[alone, alone, False]]
        shared, undetermined = _solve(others, tuple(name for name in names if name not in its))
        beta = None
        if shared is not None:
            W, Y, beta = factors[k][:, b:-1], factors[k][:, -1], np.zeros(b)
            beta[~alone] = shared
            beta[alone] = np.linalg.lstsq(W[:, alone], Y - W @ beta)[0]
        found.append((beta, undetermined))
    return found


def _rows_of(evidence: FitData, k: int) -> tuple[Array, Array, Array, NDArray[np.intp]]:
    """Z, W (r, b), Y (r,) and joints (r,) of recording k, of the estimated parameters; zero in unused rows."""
    observed, n = evidence.observed, evidence.observed.tau.shape[1]
    indices = np.array([observed.system.names.index(name) for name in evidence.estimate.names])
    system = observed.system
    part = spans_of([own.count * own.rows for own in system.spans])[k]
    instruments = system.W if evidence.Z is None else evidence.Z
    W, Y, Z, used = (part_of(x, n, part) for x in (system.W, system.Y, instruments, system.used))
    joints = np.repeat(np.arange(n), part.stop - part.start)
    return Z[:, indices] * used[:, None], W[:, indices] * used[:, None], Y * used, joints


def _solve(R: Array, names: tuple[str, ...]) -> tuple[Array | None, list[str]]:
    """Parameters (b,) from weighted rows [Z W Y], or the names of undetermined ones."""
    b = len(names)
    Z, W, Y = R[:, :b], R[:, b:-1], R[:, -1]
    undetermined = undetermined_parameters(Z, names)
    if undetermined:
        return None, undetermined
    Q = np.linalg.qr(Z / np.linalg.norm(Z, axis=0))[0]
    A, d = Q.T @ W, np.linalg.norm(W, axis=0)
    undetermined = undetermined_parameters(A, names)
    if undetermined:
        return None, undetermined
    return np.linalg.solve(A / d, Q.T @ Y) / d, []


def _recordings_line(evidence: FitData, found: tuple[HeldOut | None, ...]) -> TrustLine:
    """The line of several recordings, with those that the others cannot predict."""
    squares, figures, without = np.zeros(3), [], []
    for part, one in zip(evidence.recordings, found, strict=True):
        assert one is not None
        name, held, trained = part.problem.signals.recording, one.error_percent, one.trained_percent
        if held is None or trained is None:
            why = f"{', '.join(one.undetermined[:8])} undetermined" if one.undetermined else "it has no torque"
            without.append(f"{name} cannot be predicted by the others: {why}")
            continue
        squares += (one.torque * np.array([held, trained, 1.0])) ** 2
        figures.append(Figure(name=name, value=held, expected=trained))
    if not figures:
        return TrustLine("held-out blocks", "cannot tell", "; ".join(without))
    error, training = (float(np.sqrt(x / squares[2])) for x in squares[:2])
    text = "; ".join([f"error {error:.3g} % of recordings held out, {training:.3g} % trained", *without])
    return _line(evidence, text, (error, training), "record more", figures)


def _line(evidence: FitData, text: str, errors: tuple[float, float], cure: str, figures: list[Figure]) -> TrustLine:
    """The line of errors in percent, held out and trained."""
    shown, limit = tuple(figures), MAX_HELD_OUT_RATIO * errors[1]
    if errors[0] <= limit:
        return TrustLine("held-out blocks", "ok", text, errors[0], figures=shown, unit="%", limit=limit)
    text += f": the fit does not generalise: {cure}, with more varied motion, or fit with --essential"
    if evidence.problem.signals.robot.gain_known:
        text += ", or take the parameters of --consistent, which generalise better"
    far, finding = errors[0] > MAX_HELD_OUT_RATIO_NOT_POSITIVE * errors[1], "does not generalise"
    line = TrustLine("held-out blocks", "caution", text, errors[0], finding, figures=shown, unit="%", limit=limit)
    return replace(line, fails_held_out=far)
