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
    if native_loops():
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
    """True if the environment asks XLA to compile loops into native functions."""
    return _OPTION in os.environ.get("XLA_FLAGS", "")


def _backend_has_started() -> bool:
    """Test whether JAX has a backend; there is no public function for it."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    started = getattr(bridge, "backends_are_initialized", None)
    return bool(started and started())
