"""What a viewer's text panel says of a fit, of a recording that is not fitted, and of two fits side by side."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..data import Signals
from ..methods import Fit
from ..regression import Settings
from ..report import Difference, Value, Values, difference_lines, differences, fit_json, iv_lines, plan_lines, rows_told
from ..study import Run, summaries
from .curves import model_stride, thinning
from .robot_drawing import pose_stride
from .session_panels import health_line


def fit_markdown(signals: Signals, fit: Fit, own: Values, others: Sequence[Values]) -> str:
    """The report as Markdown: errors, warnings, settings, parameters, what is drawn."""
    told = fit_json(signals, fit)
    parameters, kept = told["parameters"], told["essential"]
    regrouped = [p for p in parameters if p["expression"] != p["name"]]
    percent = ("relative_error_percent", "moving_relative_error_percent", "standing_relative_error_percent")
    reason = f": {fit.iv.reason}" if fit.iv and fit.iv.reason else ""
    lines = [
        f"# {signals.robot.name}: {_number(told[percent[0]], '.1f')} % relative torque error",
        *(f"- **warning: {warning}**" for warning in fit.warnings),
        f"- {fit.method.upper()}, {fit.status}{reason}: {len(parameters)} parameters, {len(kept['names'])} of them essential",
        *(f"- {own.label} and {values.label}: {line}" for values in others for line in _compared(own, values)),
        *(f"- {line}" for line in plan_lines(signals, fit.settings, used="fitted")),
        f"- cond(W) {told['condition_number']:.4g}, scaled {told['condition_number_scaled']:.4g}; {rows_told(fit)}",
        *(f"- {line}" for line in (iv_lines(fit.iv) if fit.iv else [])),
        *([f"- {line}"] if (line := health_line(signals)) else []),
        "\n## Relative torque error, %",
        "| joint | unit | all rows | moving | standing |\n|---|---|--:|--:|--:|",
        *(
            f"| {e['name']} | {e['unit']} | {' | '.join(_number(e[p], '.2f') for p in percent)} |"
            for e in told["joints"]
        ),
        *(_direct(fit) if fit.iv and fit.iv.direct else []),
        "\n## Parameters",
        "| name | value | σ | % | σ HAC | unit | |\n|---|--:|--:|--:|--:|---|---|",
        *(
            f"| {p['name']} | {p['value']:.4g} | {p['sigma']:.2g} | {_number(p['sigma_percent'], '.3g')} | "
            f"{_number(p['sigma_hac'], '.2g')} | {p['unit']} | {'essential' if p['essential'] else ''} |"
            for p in parameters
        ),
        "\nσ assumes white residuals; σ HAC (Newey, West) holds for correlated ones too.",
        *(line for values in others for line in _difference_lines(own, values)),
        *(["\n## What they stand for"] if regrouped else []),
        *(f"- {p['name']} = {p['expression']}" for p in regrouped),
        "\n## What is drawn",
        "- IDM, in orange: the torque of the inverse model with these parameters along the filtered motion.",
        *(
            ["- DDM and simulated, in blue: the robot simulated with these parameters, in closed loop."]
            if fit.iv and fit.iv.simulated
            else []
        ),
        "- Residual, in red: of the decimated rows, measured and modelled torque through the same filter, as fitted; its "
        "autocorrelation over the lag, in grey the bounds ±2/√N of white noise; the distribution of the rows that move, within "
        "four sigma (1.48 times the median of its size), in grey the normal one.",
        *(
            [
                "- Over a position: rms of the reference less the measured position; sim, in percent of its variation, how far "
                "the simulated robot is off the measured position."
            ]
            if signals.q_ref is not None and fit.iv and fit.iv.simulated
            else []
        ),
        *_drawn(signals, fit.settings, "Filtered curves and IDM"),
        f"\n`{signals.recording}` sha256 `{signals.sha256}`",
    ]
    return "\n".join(lines) + "\n"


def recording_markdown(signals: Signals, plan: Settings | None, refusal: str | None) -> str:
    """What is known of a recording before a fit; `refusal` says why it cannot be fitted."""
    robot, warnings = signals.robot, plan.warnings if plan else ()
    reference = "with" if signals.q_ref is not None else "without"
    lines = [
        f"# {robot.name}: recorded, not fitted",
        *([f"- **cannot be fitted: {refusal}**"] if refusal else []),
        *(f"- **warning: {warning}**" for warning in warnings),
        f"- {len(signals.q)} samples at {signals.sample_rate_hz:g} Hz, {signals.t_s[-1]:.3f} s, {reference} reference",
        *(f"- {line}" for line in (plan_lines(signals, plan, used="a fit would use") if plan else [])),
        *([f"- {line}"] if (line := health_line(signals)) else []),
        "\n## Ranges",
        "| joint | position | unit | effort | unit |\n|---|--:|---|--:|---|",
        *(
            f"| {joint.name} | {signals.q[:, j].min():.4g} to {signals.q[:, j].max():.4g} | {joint.position_unit} | "
            f"{signals.effort[:, j].min():.4g} to {signals.effort[:, j].max():.4g} | {robot.effort_units[j]} |"
            for j, joint in enumerate(robot.joints)
        ),
        "\n## What is drawn",
        *_drawn(signals, plan, "Filtered curves"),
        f"\n`{signals.recording}` sha256 `{signals.sha256}`",
    ]
    return "\n".join(lines) + "\n"


def comparison_markdown(own: Values, other: Values) -> str:
    """Two fits side by side."""
    lines = [f"# {own.label} and {other.label}", *(f"- {line}" for line in _compared(own, other))]
    return "\n".join([*lines, *_difference_lines(own, other)]) + "\n"


def _compared(own: Values, other: Values) -> list[str]:
    return difference_lines(own, other, differences(own, other))


def _difference_lines(own: Values, other: Values) -> list[str]:
    return [
        f"\n## {own.label} and {other.label}",
        f"| name | {own.label} | σ | {other.label} | σ | difference in σ | unit |\n|---|--:|--:|--:|--:|--:|---|",
        *(_difference_row(d) for d in differences(own, other)),
    ]


def _difference_row(d: Difference) -> str:
    def cells(x: Value | None) -> str:
        return "- | -" if x is None else f"{x.value:.4g} | {x.spread:.2g}"

    return f"| {d.name} | {cells(d.a)} | {cells(d.b)} | {_number(d.off_sigma, '+.2f')} | {d.unit} |"


def _direct(fit: Fit) -> list[str]:
    assert fit.iv is not None
    return [
        "\n## Simulated robot against the recording, %",
        "| joint | position | torque |\n|---|--:|--:|",
        *(
            f"| {d.name} | {_number(d.position_error_percent, '.2f')} | {_number(d.torque_error_percent, '.2f')} |"
            for d in fit.iv.direct
        ),
    ]


def _drawn(signals: Signals, plan: Settings | None, filtered: str) -> list[str]:
    """How the curves come from the samples, and what of them is shown."""
    N, fs = len(signals.q), signals.sample_rate_hz
    step, stride = thinning(N), model_stride(signals, plan) if plan else 1
    lines = [
        "- Measured, in grey: the recording as it is, all of it; dq and ddq are central differences of the raw position, and "
        "off where noise would drown the rest: a click in the legend shows them."
    ]
    if plan is not None and plan.cutoff_hz is not None:
        lines.append("- Filtered, in orange: the measured motion through the low-pass, over the span to fit.")
    if step == 1:
        lines.append("- Curves show every sample.")
    else:
        lines.append(f"- For display, of every {step} samples measured curves show the lowest and the highest.")
    if stride > 1:
        lines.append(f"- {filtered} show every {stride}th sample, {fs / stride:g} a second.")
    lines.append(f"- The robot takes {fs / pose_stride(N, fs):.3g} poses a second.")
    return lines


def _number(x: float | None, form: str) -> str:
    return "-" if x is None else format(x, form)


def study_markdown(robot: str, runs: Sequence[Run], true: NDArray[np.float64], notes: Sequence[str]) -> str:
    """A study's summaries as a table, and what it varied."""
    lines = [
        f"# {robot}: {len(runs)} runs",
        "",
        "| cut-off | method | median error % | worst % | converged % |",
        "|---|---|---|---|---|",
    ]
    for s in summaries(runs, true):
        told = f"{s.cutoff:g} x bandwidth" if s.cutoff else "none"
        share = "" if s.converged_percent is None else f"{s.converged_percent:.1f}"
        errors = (f"{x:.3f}" if math.isfinite(x) else "-" for x in (s.median_error_percent, s.worst_error_percent))
        lines.append(f"| {told} | {s.method} | {' | '.join(errors)} | {share} |")
    return "\n".join([*lines, *(f"\n{note}" for note in notes)])
