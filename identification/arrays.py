"""The array type of the package."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""float64 of any shape; docstrings give the shape, time first: (N, n) is samples by joints."""
