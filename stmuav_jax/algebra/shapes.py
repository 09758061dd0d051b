"""Names for the array shapes used throughout (jaxtyping aliases)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Shaped

Scalar = Float[Array | np.ndarray, ""]
Flag = Bool[Array | np.ndarray, ""]
Vec3 = Float[Array | np.ndarray, "3"]
Quat = Float[Array | np.ndarray, "4"]
Mat3 = Float[Array | np.ndarray, "3 3"]
Mat34 = Float[Array | np.ndarray, "3 4"]
Mat4 = Float[Array | np.ndarray, "4 4"]
Vec3s = Float[Array | np.ndarray, "... 3"]
Quats = Float[Array | np.ndarray, "... 4"]
Vector = Float[Array | np.ndarray, " _"]
Matrix = Float[Array | np.ndarray, "_ _"]
AnyArray = Shaped[Array | np.ndarray, "..."]

# What a user may write for an array: a number, an array, or a (nested) sequence.
Numbers = ArrayLike | Sequence[Any]
