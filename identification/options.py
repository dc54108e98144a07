"""Values of command-line options: text in, a number in its range out, `ValueError` otherwise."""


def not_negative(text: str) -> float:
    """A finite number from 0."""
    return 0.0 if float(text) == 0 else above_zero(text)


def cutoffs(text: str) -> tuple[float, ...]:
    """Cut-offs separated by commas."""
    return tuple(cutoff(part) for part in text.split(","))


def factors(text: str) -> tuple[float, ...]:
    """Numbers above 0 separated by commas."""
    return tuple(above_zero(part) for part in text.split(","))


def share(text: str) -> float:
    """A percentage from 0 to below 100."""
    value = float(text)
    if not 0 <= value < 100:
        raise ValueError(text)
    return value


def cutoff(text: str) -> float:
    """A cut-off above 0, or 0 for `none`."""
    return 0.0 if text == "none" else above_zero(text)


def above_zero(text: str) -> float:
    """A finite number above 0."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError(text)
    return value


def positive(text: str) -> int:
    """A whole number from 1."""
    value = int(text)
    if value < 1:
        raise ValueError(text)
    return value
