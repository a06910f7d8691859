"""Arrays by the kind of their numbers; ``Float[Array, "T ny"]`` (jaxtyping) adds a shape."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]
