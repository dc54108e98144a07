"""The array types of the package, which have any shape.

Docstrings give the shape, with time first: (N, n) is samples by joints.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
