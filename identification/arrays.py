"""The array types of the package, of any shape; docstrings give the shape, time first: (N, n) is
samples by joints.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
