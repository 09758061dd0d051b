"""States of a run between its saved times, as accurate as its steps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..checks.errors import SettingError
from ..checks.numbers import as_jax
from ..checks.shapes import Numbers
from ..mechanics.internal import with_internal
from ..mechanics.state import State
from ..mechanics.system import System
from .method import Method
from .run import Run
from .trajectory import integrate


def states_at(run: Run, times: Numbers) -> State:
    """States of a run at any times within it, arrays (k, n, .).

    Each state is integrated from the last saved state before it with the run's own method; a
    polynomial between steps would be of lower order than the steps.

    Args:
        times: times (k,) [s], in any order.

    Raises:
        SettingError: a time is not finite or outside the run.
    """
    return between(run, times)[0]


def between(run: Run, times: Numbers) -> tuple[State, np.ndarray]:
    """States at any times as in `states_at`, and the actuator states of the forces (k, m)."""
    ts = np.atleast_1d(np.asarray(times, dtype=float))
    first, last = run.ts[0], run.ts[-1]
    inside = np.isfinite(ts) & (ts >= first) & (ts <= last)
    if not np.all(inside):
        raise SettingError(
            f"The run covers {first:g} s to {last:g} s, but a state at {ts[~inside][0]:g} s is wanted."
        )
    before = np.searchsorted(run.ts, ts, side="right") - 1
    saved = (run.states, run.trajectory.internal)
    starts = jax.tree.map(lambda x: as_jax(np.asarray(x)[before]), saved)
    method = dataclasses.replace(run.method, event=None)
    spans = as_jax(np.stack([run.ts[before], ts], axis=1))
    found = _ends(run.scene.system, method, starts, spans)
    return jax.tree.map(np.asarray, found)


@kept_jit
def _ends(
    system: System, method: Method, starts: tuple[State, Array], spans: Float[Array, "k 2"]
) -> tuple[State, Float[Array, "k m"]]:
    def end(start: tuple[tuple[State, Array], Array]) -> tuple[State, Array]:
        (state, z), span = start
        path = integrate(with_internal(system, z), state, span, method)
        # a saved state is returned unchanged, not by way of the formulation's coordinates
        saved = span[0] == span[1]
        reached = (path.states, path.internal)
        return jax.tree.map(lambda x, y: jnp.where(saved, y, x[-1]), reached, (state, z))

    return jax.lax.map(end, (starts, spans))
