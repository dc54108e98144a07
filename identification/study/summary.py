"""What the runs of a study amount to: bias, spread, coverage of the intervals, verdicts that are wrong."""

from collections.abc import Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np

from ..arrays import Array
from .draws import Study
from .study import Judged, Run

FALSE_ERROR = 5.0  # times the error of least squares at the rule's cut-off
FALSE_TRUST = 3.0  # half-widths that an essential parameter may be off for `trust`
INSIDE = 2.0  # half-widths within which nothing is wrong
NORMAL = 1.96  # half-width of 95 % of a normal distribution, in deviations
_PER_METHOD = ("beta", "sigma", "error")


@dataclass(frozen=True, kw_only=True, eq=False)
class Summary:
    """Runs at one cut-off by one method: of wls those with an estimate, of iv those that converged. NaN where there are none.

    `bias_percent` and `spread_percent` are norms over all parameters in percent of the norm of the true ones;
    `sigma_over_spread` is the median over the parameters of the formula's deviation by the observed one.
    `false_percent` is the share of runs called converged whose M is not positive, or whose error is over `FALSE_ERROR`
    times that of least squares at the rule's cut-off on the same recording. By luck that may be right to many digits.

    Of the printed 95 % intervals: `coverage_percent`, the share of true values inside, over all parameters, and
    `half_over_spread`, the median over the parameters of half-width by 1.96 times the observed deviation. Of the verdicts of
    all runs here: `false_trust` counts those with `trust` though an essential parameter is more than `FALSE_TRUST` half-widths
    off or M is not positive; `false_caution` those of the `clean` runs in which a test says caution or worse. Clean is a run
    whose fit is told all but the noise, with every essential parameter inside `INSIDE` half-widths and M positive.
    """

    method: str
    cutoff: float
    runs: int
    bias_percent: float
    spread_percent: float
    sigma_over_spread: float
    median_error_percent: float
    worst_error_percent: float
    converged_percent: float | None
    mean_passes: float | None
    false_percent: float | None
    coverage_percent: float
    half_over_spread: float
    verdicts: int
    trusted: int
    false_trust: int
    clean: int
    false_caution: int


def summaries(runs: Sequence[Run], true: Array) -> list[Summary]:
    """One summary per cut-off and method; `true` (b,) are the values simulated with."""
    found = []
    for cutoff in sorted({r.cutoff for r in runs}, key=lambda c: c or np.inf):
        here = [r for r in runs if r.cutoff == cutoff]
        settled = [r for r in here if r.status == "converged"]
        false = [r for r in settled if not (r.positive and r.error_iv <= FALSE_ERROR * r.error_tuned_ls)]
        solved = [r for r in here if np.isfinite(r.error_ls)]
        for method, used in (("wls", solved), ("iv", settled)):
            kind = "ls" if method == "wls" else "iv"
            every = [(r, judged) for r in here if (judged := getattr(r, kind)) is not None]
            beta, sigma, errors = (_stacked(used, f"{name}_{kind}", true) for name in _PER_METHOD)
            spread = beta.std(axis=0, ddof=1) if len(used) > 1 else np.full(len(true), np.nan)
            found.append(
                Summary(
                    method=method,
                    cutoff=cutoff,
                    runs=len(used),
                    bias_percent=float(100 * np.linalg.norm(beta.mean(axis=0) - true) / np.linalg.norm(true)),
                    spread_percent=float(100 * np.linalg.norm(spread) / np.linalg.norm(true)),
                    sigma_over_spread=float(np.median(np.median(sigma, axis=0) / spread)),
                    median_error_percent=float(100 * np.median(errors)),
                    worst_error_percent=float(100 * errors.max()),
                    converged_percent=100 * len(settled) / len(here) if method == "iv" else None,
                    mean_passes=float(np.mean([r.passes for r in settled])) if method == "iv" and settled else None,
                    false_percent=100 * len(false) / len(here) if method == "iv" else None,
                    coverage_percent=_coverage([getattr(r, kind) for r in used], true),
                    half_over_spread=_half_over_spread([getattr(r, kind) for r in used], spread),
                    verdicts=len(every),
                    trusted=sum(judged.verdict == "trust" for _, judged in every),
                    false_trust=sum(false_trust(judged, true) for _, judged in every),
                    clean=sum(clean(r, judged, true) for r, judged in every),
                    false_caution=sum(clean(r, judged, true) and bool(judged.doubts) for r, judged in every),
                )
            )
    return found


def _stacked(runs: Sequence[Run], name: str, true: Array) -> Array:
    """An attribute of all runs (runs, ...); a row of NaN where there are no runs."""
    return np.array([getattr(run, name) for run in runs]) if runs else np.full((1, len(true)), np.nan)


def false_trust(judged: Judged, true: Array) -> bool:
    """Whether a fit says `trust` and should not: an essential parameter far off, or M not positive."""
    wrong = not judged.positive or bool((judged.off(true)[judged.essential] > FALSE_TRUST).any())
    return judged.verdict == "trust" and wrong


def clean(run: Run, judged: Judged, true: Array) -> bool:
    """Whether there is nothing to be cautious of: the fit is told all but the noise, and is right."""
    told = run.drawn is not None and run.drawn.modelled
    return told and judged.positive and bool((judged.off(true)[judged.essential] <= INSIDE).all())


def _coverage(judged: Sequence[Judged | None], true: Array) -> float:
    inside = [one.off(true) <= 1 for one in judged if one is not None]
    return float(100 * np.mean(inside)) if inside else np.nan


def _half_over_spread(judged: Sequence[Judged | None], spread: Array) -> float:
    halves = [0.5 * (one.high - one.low) for one in judged if one is not None]
    return float(np.median(np.median(halves, axis=0) / (NORMAL * spread))) if halves else np.nan


def study_json(study: Study, runs: Sequence[Run], names: Sequence[str], true: Array) -> dict[str, Any]:
    """A study as JSON: settings, `names` (b,) and `true` (b,) of the base parameters, summaries, every run."""

    def plain(value: Any) -> Any:
        if is_dataclass(value):
            return {name: plain(x) for name, x in vars(value).items()}
        if isinstance(value, np.ndarray | tuple):
            return [plain(x) for x in value]
        value = value.item() if isinstance(value, np.generic) else value
        return None if isinstance(value, float) and not np.isfinite(value) else value

    return {
        "study": plain(study),
        "parameters": list(names),
        "true": [float(x) for x in true],
        "summaries": [plain(s) for s in summaries(runs, true)],
        "runs": [plain(r) for r in runs],
    }
