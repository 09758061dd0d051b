"""Derivatives of flights' final values by the numbers that were drawn."""

from dataclasses import replace
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..dynamics.integrate import integrate
from ..dynamics.problem import begin
from ..mechanics.errors import SettingError
from .batch import FlightWork
from .flights import Drawn
from .signal import View

# Flights differentiated together: derivatives by d factors are d + 1 flights each.
TOGETHER = 8


def final_gradients(
    work: FlightWork, first: int, count: int
) -> dict[str, Float[np.ndarray, "count d"]]:
    """Derivatives of a study's final values by its factors, through the flight, in forward mode.

    For `sensitivity.derivative_measures`. NaN for flights that fail.

    Returns:
        by quantity (count, d), in its unit over the factor's.

    Raises:
        SettingError: the study takes no final values, or is in single precision.
    """
    study = work.study
    wanted = [name for name, q in study.quantities.items() if q.take == "final"]
    if not wanted:
        raise SettingError(f"Study '{study.name}' takes no final values to differentiate.")
    if study.flights.float32:
        raise SettingError("Derivatives are found in double precision only.")
    of, direction = study.signals(), jnp.asarray(work.direction)
    ts = jnp.array([0.0, study.t1])

    def final(values: Any, seed: Any) -> Any:
        problem, state0 = work.plan.make(Drawn(values, seed))
        # the study's flights are not differentiated, these are
        method = replace(problem.method, steps="sensitivities")
        path = integrate(problem.model.system, state0, ts, method)
        end = jax.tree.map(lambda x: x[-1], path.states)
        y = jnp.concatenate([begin(problem, ts[0], end).y[: problem.n_state], path.internal[-1]])
        view = View(problem, ts[1], y, direction)
        fine = path.result == diffrax.RESULTS.successful
        # a product, so that the derivatives are marked too
        return jnp.stack([of[name].of(view) * jnp.where(fine, 1.0, jnp.nan) for name in wanted])

    drawn = jnp.asarray(study.sampling.draw(first, count))
    each = jax.jit(
        lambda samples: jax.lax.map(
            lambda one: jax.jacfwd(final)(*one), samples, batch_size=min(TOGETHER, count)
        )
    )
    found = np.asarray(each((drawn, jnp.asarray(work.seeds(first, count)))))
    return {name: found[:, k] for k, name in enumerate(wanted)}
