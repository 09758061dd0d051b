"""Names for the array shapes used throughout (jaxtyping aliases)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Float

Scalar = Float[Array, ""]
Vec3 = Float[Array, "3"]
Quat = Float[Array, "4"]
Mat3 = Float[Array, "3 3"]
Mat34 = Float[Array, "3 4"]
Mat4 = Float[Array, "4 4"]
Vector = Float[Array, " _"]
Matrix = Float[Array, "_ _"]

# The same as arguments, where NumPy arrays do as well.
# (stacks of them have further axes at the end)
Vec3s = Float[Array | np.ndarray, "3 *#s"]
Quats = Float[Array | np.ndarray, "4 *#s"]
Vec3Like = Float[Array | np.ndarray, "3"]
QuatLike = Float[Array | np.ndarray, "4"]
Mat3Like = Float[Array | np.ndarray, "3 3"]

# What a user may write for an array: a number, an array, or a (nested) sequence.
Numbers = ArrayLike | Sequence[Any]
