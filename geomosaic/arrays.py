"""Types of arrays, by what they hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Ints = NDArray[np.intp]
Bools = NDArray[np.bool_]
Floats32 = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Ints32 = NDArray[np.int32]
Ints64 = NDArray[np.int64]
