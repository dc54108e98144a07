"""Errors of the package, and the one line in which they are told."""

from collections.abc import Sequence


def one_line(text: str) -> str:
    """`text` without line breaks and control characters, whatever file names and file contents it quotes."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in " ".join(text.split()))


def listed(names: Sequence[str]) -> str:
    """Names for an error that says what was expected; of many the first 30."""
    shown = ", ".join(names[:30])
    return shown + (f" and {len(names) - 30} more" if len(names) > 30 else "") or "(nothing)"


class AcquisitionError(Exception):
    """Bad input or a failed session, told in one line: the file, the place, the value and what was expected."""

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
