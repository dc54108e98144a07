"""Numbers as text."""

ROUNDING = 1e-18  # SI: no mass, length or inertia of a robot is so small


def text_of(*values: float) -> str:
    """Numbers with all their digits, separated by blanks; rounding of a zero is written as zero."""
    return " ".join(repr(float(x) if abs(x) > ROUNDING else 0.0) for x in values)
