"""The types of arrays, once for the package."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; the docstring that uses it says which
Ints = NDArray[np.int64]
