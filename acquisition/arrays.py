"""Array types of the package."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; docstrings give it
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def first_true(x: Bools) -> int | None:
    """Return the first index at which x (N,) is true; None if there is none."""
    return int(np.argmax(x)) if x.any() else None
