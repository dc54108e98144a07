"""Faults that a simulated drive shows on demand."""

from dataclasses import dataclass
from typing import Literal

FaultKind = Literal[
    "emergency", "silent", "reset", "late", "missing", "duplicate", "short", "stuck", "slow", "deaf", "clear"
]


@dataclass(frozen=True, kw_only=True)
class SimulatedFault:
    """A fault of drive `node` from the `sync`-th SYNC that it answers (from 1), for `count` SYNCs.

    `emergency`: continuous over current (2310h); `reset`: it boots; `late`, `missing`, `duplicate`, `short`: its PDOs are;
    `silent`: it sends nothing from then on; `stuck`: its joint stands still from then on; `slow`: it stays in switched on
    when it is to be enabled; `deaf`: it neither answers SYNC nor applies the PDOs received before it; `clear`: the `bits` of
    its statusword are 0.
    """

    kind: FaultKind
    node: int
    sync: int
    count: int = 1
    bits: int = 0
