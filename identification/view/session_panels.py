"""How the recording went: phases of the session and the span fitted as bands, events as a log, the recorder's counters."""

import numpy as np
from numpy.typing import NDArray

from ..data import Signals
from ..regression import Settings
from .panels import BLUE, GREEN, GREY, JOINTS, ORANGE, Color, Curve, Lanes, Log, Plot

Vector = NDArray[np.float64]

FOLLOWS = "track"  # the phase that a fit uses
MOST_LINES = 2000  # of the log
EXPECTED = ("phase", "mark", "disabled", "end")  # kinds of events that need no attention
TOTALS = ("frames", "syncs")  # counters of what went right: they would dwarf the others


def span_lanes(signals: Signals, plan: Settings | None, *, fitted: bool) -> Lanes | None:
    """The session's phases and what of the recording the fit uses, or would use; None where neither is known."""
    end_s = float(signals.t_s[-1])
    lanes: dict[str, list[tuple[float, str, Color]]] = {}
    phases = [event for event in signals.events if event.kind == "phase"]
    if phases:
        colors: dict[str, Color] = {FOLLOWS: GREEN}
        states: dict[float, tuple[float, str, Color]] = {}
        for event in phases:
            color = colors.setdefault(event.text, (GREY, BLUE, *JOINTS[4:])[len(colors) % 6])
            at = within(event.t_s, end_s)
            states[at] = (at, event.text, color)  # of those before the first sample, the last
        lanes["phase"] = list(states.values())
    if plan is not None:
        start, stop = (float(signals.t_s[k]) for k in (plan.start, plan.stop - 1))
        name = "fitted" if fitted else "to_be_fitted"
        lanes[name] = [(start, plan.span, ORANGE), (stop, "", GREY)]
        if start > 0:
            lanes[name].insert(0, (0.0, "", GREY))
    if not lanes:
        return None
    return Lanes(
        path=("session",), title="phases of the session, span to fit" if phases else "span to fit", lanes=lanes
    )


def event_log(signals: Signals) -> Log | None:
    """What happened, None where nothing did. The seconds stand in the text: a viewer's column of times is too narrow for them.

    What is outside of the samples stands at their ends.
    """
    end_s, lines = float(signals.t_s[-1]), []
    for event in signals.events[:MOST_LINES]:
        at = within(event.t_s, end_s)
        told = "" if at == event.t_s else f" ({'before' if at == 0 else 'after'} the samples)"
        lines.append((at, event.kind not in EXPECTED, f"{event.t_s:.3f} s  {event.kind}: {event.text}{told}"))
    return Log(path=("events",), title=f"events: {len(signals.events)}", lines=lines) if lines else None


def health_plot(signals: Signals) -> Plot | None:
    """The recorder's counts of what went wrong, None where it kept none; the title says what they come to."""
    end_s = float(signals.t_s[-1])
    curves: list[Curve] = []
    for name, (t_s, counts) in signals.health.items():
        known = np.isfinite(counts)
        if not known.any():
            continue
        t_s, counts = t_s[known], counts[known]
        if name not in TOTALS and not name.endswith("_s"):
            before = np.flatnonzero(t_s < 0)[-1:]  # counts so far, as the samples begin
            k = np.r_[before, np.flatnonzero((t_s >= 0) & (t_s <= end_s))]
            line = np.clip(t_s[k], 0, end_s), counts[k]
            if len(k) == 0 or line[0][-1] < end_s:
                line = np.append(line[0], end_s), np.append(line[1], counts[-1])
            if len(line[0]) == 1:
                line = np.array([0.0, end_s]), np.repeat(line[1], 2)
            color = JOINTS[len(curves) % len(JOINTS)]
            curves.append(Curve(key=name, color=color, line=line, width=2.0))
    faults = [f"{c.key} {c.line[1][-1]:g}" for c in curves if c.line[1][-1]]
    title = f"counted: {', '.join(faults) or 'no fault'}"
    return Plot(path=("health",), title=title, curves=tuple(curves)) if curves else None


def within(t_s: float, end_s: float) -> float:
    """A time brought to between the first sample and the last."""
    return min(max(t_s, 0.0), end_s)
