"""Integrations by the package that are compiled once for all tolerances."""

from typing import Any

import diffrax

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.solvers import butcher_coefficients

STEPS = 1_000_000


def trajectory(
    formulation: Any, solver: Any, adjoint: Any = None, steps: int = STEPS, **more: Any
) -> Any:
    """(system, state0, ts, tolerance) -> `Trajectory`; one compilation for all tolerances."""
    # runs that are not differentiated need no steps that are safe for derivatives
    kind = "state" if adjoint is None else "sensitivities"
    adjoint = diffrax.ForwardMode() if adjoint is None else adjoint

    def run(system: Any, state0: Any, ts: Any, tolerance: Any) -> stm.dynamics.Trajectory:
        how = {"rtol": tolerance, "atol": tolerance, "max_steps": steps, "steps": kind, **more}
        method = stm.Method(formulation=formulation, solver=solver, adjoint=adjoint, **how)
        return stm.integrate(system, state0, ts, method)

    return run


def evaluations(solver: Any, steps: int) -> int | None:
    """Accelerations in so many attempted steps; None for iterative solvers, which do not count."""
    if isinstance(solver, diffrax.AbstractERK):
        return len(butcher_coefficients(solver)[3]) * steps
    return None


def words(result: Any) -> str:
    """Why a run ended, in one short line."""
    return " ".join(str(diffrax.RESULTS[result]).split())[:120]
