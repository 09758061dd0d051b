"""Public names of this folder; `__init__.py` imports each when it is first used."""

from . import rotation as rotation
from .compiler import (
    compiler_options as compiler_options,
    outer_jit as outer_jit,
    quick_jit as quick_jit,
)
from .lapack import (
    inverse as inverse,
    pseudoinverse as pseudoinverse,
    singular_values as singular_values,
    solve as solve,
)
from .least_squares import (
    CorrectedLevenbergMarquardt as CorrectedLevenbergMarquardt,
    Search as Search,
    SearchReason as SearchReason,
    search as search,
)
from .native.program import (
    use_native_code as use_native_code,
)
from .sampled import (
    Sampled as Sampled,
)
from .space import (
    Composite as Composite,
    Concatenated as Concatenated,
    CyclicVector as CyclicVector,
    Rotation as Rotation,
    Vector as Vector,
)
