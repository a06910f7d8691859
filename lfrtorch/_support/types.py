"""Arrays by the kind of their numbers, and the letters for their axes.

An annotation adds the shape (jaxtyping): ``u: Float[Tensor, "R T nu"]``,
``y: Float[Array, "T ny"]``, ``G: Complex128[Complex, "F ny nu"]``. The tests check it at every
call. A shape of one axis begins with a space, because ruff takes a single word for a name:
``Float[Tensor, " P"]``.

=====  =====================================  =====  =====================================
R      records, or realisations               nu ny  inputs and outputs of the model
T      samples                                nx     states
B      samples of a block                     nz nw  inputs and outputs of the static map
F      DFT lines                              nn     neurons
P      parameters                             C K n  columns, those that are kept, any size
M      residuals, or rows
=====  =====================================  =====  =====================================
"""

from typing import Any

import numpy as np

# Not numpy's NDArray: from numpy 2.5 on it is an alias that jaxtyping cannot look into.
Array = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
Complex = np.ndarray[tuple[Any, ...], np.dtype[np.complex128]]
Integers = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
Booleans = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
