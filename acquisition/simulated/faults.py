"""Faults on demand: what goes wrong with a simulated drive, and when."""

from dataclasses import dataclass
from typing import Literal

FaultKind = Literal[
    "emergency", "silent", "reset", "late", "missing", "duplicate", "short", "stuck", "slow", "deaf", "clear"
]


@dataclass(frozen=True, kw_only=True)
class SimulatedFault:
    """Something goes wrong with `node` at the `sync`-th SYNC it answers (from 1), for `count` SYNCs.

    `late`, `missing`, `duplicate`, `short` are about its PDOs; `silent` sends nothing more at all; `stuck` moves no more;
    `slow` does not get from switched on to operation enabled; `deaf` neither answers SYNC nor takes over what came before
    it; `clear` has the `bits` of its statusword at 0.
    """

    kind: FaultKind
    node: int
    sync: int
    count: int = 1
    bits: int = 0
