"""Native loops: an option of XLA that has to be set before JAX's backend starts.

XLA's CPU compiler turns an integration's `while` loop into one native function, without dispatching
its some hundred kernels one by one, if the loop's buffers are below a threshold, by default 1 kB.
With a larger one a single flight runs faster, and its program takes longer to compile; batches of many
flights run slower. A loop that calls a library gains nothing: Cholesky factorisations of small matrices
are then loops themselves (`loops`). The implicit methods keep one call of LAPACK a step, an inverse; their
loops over stages and iterations call none and become native.
"""

import os
import sys
import warnings
from functools import cache

from ..checks.errors import SettingError

_OPTION = "xla_cpu_small_while_loop_byte_threshold"
_LIST = "--xla_backend_extra_options="
_THRESHOLD = 10_000_000


def use_native_loops() -> None:
    """Let XLA compile the loops of later programs of this process into native functions.

    The option goes into the environment variable XLA_FLAGS, beside what is there; a threshold that
    is there already stays. The call is for programs that run single flights or single filters
    often; the library never makes it itself.

    Raises:
        SettingError: JAX's backend has already started, which reads the variable only once.
    """
    if _OPTION in os.environ.get("XLA_FLAGS", ""):
        return
    if _backend_has_started():
        raise SettingError(
            "use_native_loops has to be called before JAX computes anything, because JAX's "
            "backend reads XLA_FLAGS only when it starts: call it right after the imports, or "
            f"start Python with XLA_FLAGS={_LIST}{_OPTION}={_THRESHOLD}."
        )
    flags = os.environ.get("XLA_FLAGS", "").split()
    others = [flag for flag in flags if flag.startswith(_LIST)]
    kept = [flag for flag in flags if not flag.startswith(_LIST)]
    options = [flag.removeprefix(_LIST) for flag in others] + [f"{_OPTION}={_THRESHOLD}"]
    os.environ["XLA_FLAGS"] = " ".join([*kept, _LIST + ",".join(options)])


def native_loops() -> bool:
    """True if the environment asks XLA to compile loops into native functions, and XLA does so.

    A version of XLA that does not know the option says nothing. A small loop is therefore compiled
    once; where it does not become native, a RuntimeWarning says so, and programs are compiled as
    without the option. Devices other than CPUs have no such loops.
    """
    return _OPTION in os.environ.get("XLA_FLAGS", "") and _compiles_natively()


@cache
def _compiles_natively() -> bool:
    """Test whether a loop beyond XLA's own threshold becomes a native function."""
    import jax
    import jax.numpy as jnp

    if jax.default_backend() != "cpu":
        return False
    body = lambda at: (at[0] + 1, jnp.sin(at[1]) + jnp.flip(at[1]))
    run = jax.jit(lambda x: jax.lax.while_loop(lambda at: at[0] < 9, body, (0, x)))
    # XLA marks the functions that it compiles natively as small calls
    given = jax.ShapeDtypeStruct((1000,), jnp.float32)
    if "small_call" in str(run.lower(given).compile().as_text()):
        return True
    warnings.warn(
        f"This version of jaxlib does not compile loops into native functions for the option {_OPTION} "
        "in XLA_FLAGS. Results are the same; single flights take as long as without the option.",
        RuntimeWarning,
        stacklevel=3,
    )
    return False


def _backend_has_started() -> bool:
    """Test whether JAX has a backend; there is no public function for it."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    started = getattr(bridge, "backends_are_initialized", None)
    return bool(started and started())
