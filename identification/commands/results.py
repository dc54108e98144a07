"""How commands end: results printed whole, and the exit status of one that is not to be trusted."""

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from acquisition.errors import one_line

if TYPE_CHECKING:
    from ..report import Document


def print_results(*items: "Document | str") -> None:
    """Reports and lines on standard output, whole whatever its width."""
    from ..report import print_whole

    print_whole(*items)


def untrusted(reasons: Sequence[str]) -> int:
    """The exit status of a result; one that is not to be trusted has a line on stderr that says why."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
