"""How commands end: results printed whole, and the exit status of one that is not to be trusted."""

import sys
from collections.abc import Sequence
from typing import Any

from acquisition.errors import one_line


def print_results(*items: Any) -> None:
    """Tables and lines on standard output, whole whatever its width."""
    from ..report import print_whole

    print_whole(*items)


def untrusted(reasons: Sequence[str]) -> int:
    """The exit status of a result; one that is not to be trusted has a line on stderr that says why."""
    if reasons:
        print(one_line(f"robot-identify: not to be trusted: {'; '.join(reasons)}"), file=sys.stderr)
    return 3 if reasons else 0
