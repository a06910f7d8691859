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

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Integers = NDArray[np.int64]
