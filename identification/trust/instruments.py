"""Tests of the instrumental variable method itself: whether it ended in a fixed point."""

from .evidence import Evidence
from .lines import TrustLine


def fixed_point_line(evidence: Evidence) -> TrustLine:
    """Whether the method ended in a fixed point that the simulated robot confirms."""
    if not evidence.fixed_point:
        text = f"{evidence.unconfirmed or 'no fixed point'}: check signs, gains, bandwidth_hz; record faster motion"
        return TrustLine(test="fixed point", level="do not use", value=None, text=text)
    if evidence.unconfirmed is not None:
        text = f"{evidence.unconfirmed}: check [controller]; compare with least squares"
        return TrustLine(test="fixed point", level="caution", value=None, text=text)
    text = (
        "settled, and the simulated robot confirms it" if evidence.method == "iv" else "least squares has one solution"
    )
    return TrustLine(test="fixed point", level="ok", value=None, text=text)
