"""Names of the array shapes that are used throughout the package (jaxtyping aliases)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float

Scalar = Float[Array, ""]
Vec3 = Float[Array, "3"]
Quat = Float[Array, "4"]
Vector = Float[Array, " _"]
# Vectors that an integrator advances: all of one call have the same length k.
StateVector = Float[Array, " k"]
Matrix = Float[Array, "_ _"]

# Shapes of arguments, for which NumPy arrays are valid too; the axes of a stack come last.
Vec3s = Float[Array | np.ndarray, "3 *#s"]
Quats = Float[Array | np.ndarray, "4 *#s"]
QuatLike = Float[Array | np.ndarray, "4"]
Mat3Like = Float[Array | np.ndarray, "3 3"]

# Forms in which a user may give an array: a number, an array, or a (nested) sequence.
Numbers = ArrayLike | Sequence[Any]
