"""Array types of the package."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]  # of any shape; docstrings give it
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
