"""The parts that are held out and predicted by the fit of the others: fifths of one recording, or each of several."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..errors import IdentificationError
from ..estimation import undetermined_parameters
from ..methods import StackedSystem
from ..regression import Regression

FIFTHS = 5  # of one recording
LEAST = 2  # parts of which a mean has a standard error

Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, eq=False)
class Part:
    """Rows that are held out together.

    Attributes:
        name: of the recording, or the number of the fifth.
        rows: (T,) whether an instant is in the part.
        own: (b,) whether only this part has a parameter, such as Off1@A: the others know nothing of it, and it is fitted there.
    """

    name: str
    rows: Mask
    own: Mask


def parts_of(observed: StackedSystem, names: Sequence[str]) -> tuple[Part, ...]:
    """Fifths of a recording, or each of several; `names` are those of the recordings in the order of their rows."""
    parameters, lengths = observed.parameters, observed.regression.parts
    T, none = sum(lengths), np.zeros(len(parameters.names), dtype=bool)
    if len(lengths) == 1:
        edges, names = np.linspace(0, T, FIFTHS + 1).round().astype(int), [f"fifth {k + 1}" for k in range(FIFTHS)]
    else:
        edges = np.cumsum([0, *lengths])
    found = []
    for k, (begin, end) in enumerate(pairwise(edges)):
        own = none
        if len(lengths) > 1:
            own = np.array(["@" in name and name in parameters.of[k] for name in parameters.names])
        found.append(Part(name=names[k], rows=np.isin(np.arange(T), np.arange(begin, end)), own=own))
    return tuple(found)


def predictable(parts: Sequence[Part], observed: Regression) -> tuple[tuple[Part, ...], dict[str, str]]:
    """The parts whose parameters the others determine; and of each other one a line that says it, by its name.

    `observed` has all terms that are tried. Raises `IdentificationError` where fewer than two are left.
    """
    found, refused = [], dict[str, str]()
    for part in parts:
        counts = (observed.fast & ~part.rows[:, None]).T.reshape(-1)
        names = tuple(name for name, own in zip(observed.system.names, part.own, strict=True) if not own)
        if lost := undetermined_parameters(observed.system.W[counts][:, ~part.own], names):
            refused[part.name] = f"{part.name} cannot be predicted by the others: {', '.join(lost[:8])} undetermined"
        else:
            found.append(part)
    if len(found) < LEAST:
        text = "; ".join(refused.values())
        expected = "recordings that each move all joints, or one of them: its fifths are then held out"
        if len(observed.parts) == 1:
            expected = "motion of all joints in all fifths of the recording"
        raise IdentificationError(
            text, key="parts held out", value=len(found), expected=f"at least {LEAST}: {expected}"
        )
    return tuple(found), refused
