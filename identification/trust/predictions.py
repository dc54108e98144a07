"""Predictions of the recording by what was not fitted to it: cross-validation.

Each block of time of one recording, or each of several recordings, is predicted by a fit of the
others, which may leave parameters undetermined. The rows of a part are those of its spans of time,
R factors of which have the same products. The prior's links are predicted with as well, all else
fitted to the others.
"""

from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from ..arrays import Array, Bools, Ints
from ..errors import NoFitError
from ..estimation import (
    Estimate,
    instrumental_variables,
    release_memory,
    spans_at,
    undetermined_parameters,
)
from ..report import TrustResult
from .evidence import BY_PRIOR, Case, Part, TrustInputs, Words, figures_of
from .prior import known_and_free

BLOCKS = 5
MAX_HELD_OUT_RATIO_NOT_POSITIVE = 3.0  # the same, where M is not positive
MAX_HELD_OUT_RATIO = 1.5  # of held-out over training error, in weighted rows

# A prediction returns the decimated torque (rows, n), the one predicted by each set of estimates
# (K, rows, n), which rows count, and by recording the instants and the rows of the fit. Each
# estimate of a set predicts an equal part of each recording.
Predict = Callable[..., tuple[Array, Array, Bools, list[Array], list[Ints]]]


@dataclass(frozen=True)
class HeldOut:
    """A recording predicted by the fit of the others, in the rows that count.

    Attributes:
        error_percent: its torque error, in percent of its torque; None if the others do not
            determine the parameters, or if it has no torque.
        undetermined: names of the parameters that the others do not determine.
    """

    error_percent: float | None
    undetermined: tuple[str, ...]


def _predicted_parts(evidence: TrustInputs) -> list[tuple[str, Part, Array, list[str]]]:
    """Return five time blocks of one recording, or each of several recordings.

    Each has its name, its time blocks, the parameters (b,) of the fit of the others that predict
    it, and those that the others do not determine. There is none if the others have too few rows.
    Per-recording parameters are fitted to their recording, since the others do not contain them.
    With drive gains each recording is divided into blocks, because none alone determines the gains.
    """
    estimate, several = evidence.estimate, evidence.by_recording
    own = [arm.own for arm in evidence.arms] if several else [set[str]()] * BLOCKS
    names = evidence.names if several else [f"block {k + 1}" for k in range(BLOCKS)]
    parts = evidence.spans(BLOCKS)
    if several:
        parts = [evidence.between(*both) for both in pairwise(evidence.ends)]
    elif sum(n := [evidence.count(part) for part in parts]) - max(n) <= len(estimate.beta):
        return []
    found = predictions_by_others([*map(evidence.factor, parts)], estimate.names, own)
    return [
        (name, part, beta, lost * several)  # blocks are predicted anyway
        for name, part, (beta, lost) in zip(names, parts, found, strict=True)
    ]


def _held_out(
    evidence: TrustInputs,
    parts: list[tuple[str, Part, Array, list[str]]],
    at: Ints,
    torques: tuple[Array, Array, Array, Bools],
) -> tuple[TrustResult | None, tuple[HeldOut, ...]]:
    """Return the result, and the errors of recordings, by rows of the time blocks `at` (T,).

    `torques` (T, n): measured, by the fit, by the others, and which count. Errors in percent are
    relative to the torque. Where the model does not hold, joints are at rest; the errors of
    weighted rows leave that out.
    """
    several, (tau, trained, by_others, counts) = evidence.by_recording, torques
    if not parts:
        return HELD_OUT.judge({"few rows": True}, count=len(evidence.estimate.beta)), ()
    errors = tau, tau - by_others, tau - trained
    norms = np.array(
        [
            [
                *(np.linalg.norm(x[counts & part[at][:, None]]) for x in errors),
                *(evidence.error(part, x) for x in (beta, evidence.estimate.beta)),
            ]
            for _, part, beta, _ in parts
        ]
    )
    told = (norms[:, 0] > 0) & [not lost for *_, lost in parts]
    names = [name for (name, *_), it in zip(parts, told, strict=True) if it]
    if not several:
        return _line_of(evidence, names, norms[told], ""), ()
    without = "; ".join(
        HELD_OUT.part(
            "no prediction",
            name=name,
            lost=bool(lost),
            names=", ".join(lost[:8]),
            resting=not lost,
        )
        for (name, _, _, lost), it in zip(parts, told, strict=True)
        if not it
    )
    found = (
        HeldOut(100 * error / torque if it else None, tuple(lost))
        for (torque, error, *_), it, (*_, lost) in zip(norms.tolist(), told, parts, strict=True)
    )
    return _line_of(evidence, names, norms[told], without), tuple(found)


def _line_of(
    evidence: TrustInputs, names: list[str], norms: Array, without: str
) -> TrustResult | None:
    """Return the result of parts by their norms (k, 5).

    The norms are of their torque, of the errors held out and fitted, and of those of weighted rows.
    `without` describes the other parts.
    """
    several = evidence.by_recording
    if not names:
        return HELD_OUT.judge({"not predicted": several, "no torque": True}, without=without)
    torque, error, training, held, trained = np.linalg.norm(norms, axis=0)
    percents, ratio = 100 * norms[:, 1:3] / norms[:, :1], held / max(trained, 1e-300)
    return HELD_OUT.judge(
        {
            "far off": trained > 0 and ratio > MAX_HELD_OUT_RATIO_NOT_POSITIVE,
            "off": trained > 0 and ratio > MAX_HELD_OUT_RATIO,
            "ok": True,
        },
        value=float(100 * error / torque),
        expected=float(100 * training / torque),
        figures=figures_of(names, percents[:, 0], 0 * percents[:, 0], percents[:, 1]),
        training=100 * training / torque,
        of_recordings=several,
        and_without=bool(without),
        without=without,
        ratio=ratio,
        more="more" if several else "longer",
        consistent=evidence.robot.gain_known,
    )


_OFF = Case(
    "caution",
    "{error}. The fit does not generalise ({ratio:.2g} times the fitted error in weighted rows)",
    "Record {more}, with more varied motion, or fit with --essential{consistent}.",
    "does not generalise",
)


HELD_OUT = Words(
    test="cross-validation",
    place=170,
    advice="Record longer, with more varied motion, or fit with `--essential`.",
    detects="Overfitting: five time blocks, or each of several recordings, are predicted by the "
    "fit of the others",
    limit="`caution`: their error is more than 1.5 times that of the fit. `do not use`: more than "
    "3 times, and M is not positive",
    cases={
        "few rows": Case(
            "skipped", "too few rows outside a block for {count} parameters", "Record longer."
        ),
        "no torque": Case("skipped", "there is no torque"),
        "not predicted": Case("inconclusive", "{without}"),
        "far off": _OFF,
        "off": _OFF,
        "ok": Case("ok", "{error}"),
    },
    parts={
        "lost": "{names} not well determined",
        "resting": "it has no torque",
        "no prediction": "{name} cannot be predicted by the others: {lost}{resting}",
        "of_recordings": " of recordings",
        "and_without": "; {without}",
        "error": "{value:.3g} %{of_recordings} held out, {training:.3g} % fitted, over the same "
        "rows{and_without}",
        "consistent": ", or use the parameters of --consistent, which generalise better",
        "not positive": "{text}. The inertia matrix is not positive",
    },
    unit="%",
)


def predictions_by_others(
    factors: Sequence[Array], names: tuple[str, ...], own: Sequence[Collection[str]]
) -> list[tuple[Array, list[str]]]:
    """Return the parameters (b,) that predict each part by the fit of the others.

    They are computed from R factors of weighted rows [Z W Y]; the parameters `own` are fitted to
    the part itself. The names of those that the others do not determine are returned too.
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


def _betas(
    evidence: TrustInputs, parts: list[tuple[str, Part, Array, list[str]]]
) -> list[Estimate]:
    """Return the estimates that predict the parts.

    Parameters that the other parts do not determine keep the values of the whole fit.
    """
    whole = evidence.estimate
    return [whole if lost else replace(whole, beta=beta) for _, _, beta, lost in parts] or [whole]


def with_predictions(
    evidence: TrustInputs, predict: Predict
) -> tuple[TrustInputs, tuple[HeldOut, ...], tuple[Array, Array, Bools, list[Array]]]:
    """Add the results of predictions by other fits and by the a priori links.

    The other fits are of other blocks or recordings. The a priori links are combined with
    everything else fitted to the others. Also return the recordings so predicted (empty for
    blocks), the torques (T, n) as measured and by the fit, which rows count, and the instants by
    recording.
    """
    system, estimate = evidence.observed.system, evidence.estimate
    release_memory(evidence.observed.C)
    cases = [(evidence, parts := _predicted_parts(evidence))]
    sets = [[estimate], _betas(evidence, parts)]
    if parts and (links := _by_links(evidence)) is not None:
        cases.append((links, parts := _predicted_parts(links)))
        known, _ = known_and_free(evidence)
        some = (known + one.values_of(system.names) for one in _betas(links, parts))
        sets.append([replace(estimate, names=system.names, beta=beta) for beta in some])
    tau, (trained, *predicted), counts, t_s, instants = predict(
        *sets, by_recording=evidence.by_recording
    )
    at = spans_at(system.spans, instants)
    found = [
        _held_out(of, parts, at, (tau, trained, one, counts))
        for (of, parts), one in zip(cases, predicted, strict=True)
    ]
    made = dict(zip((HELD_OUT.test, BY_PRIOR), (line for line, _ in found), strict=False))
    evidence = replace(evidence, made={**evidence.made, **made})
    return evidence, found[0][1], (tau, trained, counts, t_s)


def _by_links(evidence: TrustInputs) -> TrustInputs | None:
    """Return the same with the a priori links, and everything else fitted beside them.

    It is None if there are no such links, or if the recordings do not determine the rest.
    """
    if not evidence.prior or evidence.gains:
        return None
    system, (known, free) = evidence.observed.system, known_and_free(evidence)
    rest, Z = replace(system, Y=system.Y - system.W @ known), evidence.Z[:, free]
    rest = rest.with_columns(free)
    with suppress(NoFitError):
        others = instrumental_variables(rest, Z, evidence.estimate.weights).without_rows()
        return replace(
            evidence, observed=replace(evidence.observed, system=rest, Z=Z), estimate=others
        )
    return None
