"""Motion of a mechanism from sample to sample with held inputs."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..dynamics.formulations.base import Accelerations
from ..dynamics.formulations.stabilisation import Unstabilised
from ..dynamics.integration.adjoint import DiscreteAdjoint
from ..dynamics.integration.explicit import RungeKutta4
from ..dynamics.integration.problem import (
    Counts,
    IntegrationState,
    Problem,
    at_internal,
    landing,
)
from ..dynamics.method import Method
from ..mechanics.inputs import Inputs
from ..mechanics.state import State


class HeldMotion(eqx.Module):
    """Motion over one control period.

    Attributes:
        problem: prepared problem of the integration, with plain numbers for the inputs.
        inputs: inputs that are held.
        steps: steps in a period; None for steps whose length the method's tolerances choose.
    """

    problem: Problem
    inputs: Inputs
    steps: int | None = eqx.field(static=True)

    def with_method(self, **changes: Any) -> "HeldMotion":
        """Motion by a method with other fields."""
        method = dataclasses.replace(self.problem.method, **changes)
        return dataclasses.replace(self, problem=dataclasses.replace(self.problem, method=method))

    def moved(
        self, now: IntegrationState, values: Float[Array, " m"], t1: Float[Array, ""]
    ) -> IntegrationState:
        """State of the integration at t1 [s], the inputs held at values (m,)."""
        problem = self._held(values)
        if self.steps is None:
            return _adaptively(problem, now, t1)
        solver, terms = problem.solver(), diffrax.ODETerm(problem.field)
        h, steps = (t1 - now.t) / self.steps, self.steps

        def one(carry: Any, j: Any) -> tuple[Any, None]:
            y, state, result = carry
            a, b = now.t + j * h, now.t + (j + 1) * h
            found = solver.step(terms, a, b, y, problem.model, state, made_jump=True)
            fine = result == diffrax.RESULTS.successful
            result = diffrax.RESULTS.where(fine, found[4], result)
            return (found[0], found[3], result), None

        carry = (now.y, now.solver_state, now.result)
        if steps == 1:
            carry, _ = one(carry, 0)
        else:
            carry, _ = jax.lax.scan(one, carry, jnp.arange(steps))
        accepted = now.counts.accepted + steps
        counts = Counts(accepted, now.counts.rejected, now.counts.at_growth_limit)
        return dataclasses.replace(
            now, t=t1, y=carry[0], solver_state=carry[1], counts=counts, result=carry[2]
        )

    def state(self, y: Float[Array, " n"]) -> tuple[State, Float[Array, " z"]]:
        """State of all bodies, and states of force elements."""
        problem = self.problem
        n, z = problem.n_state, problem.n_internal
        return problem.method.formulation.to_state(problem.model, y[:n]), y[n : n + z]

    def work(self, y: Float[Array, " n"]) -> Float[Array, ""]:
        """Work of forces without potential since the start [J]; zero without `balances`."""
        problem = self.problem
        if not problem.method.balances:
            return jnp.zeros((), y.dtype)
        return y[problem.n_state + problem.n_internal]

    def accelerations(
        self, t: Array, state: State, internal: Array, values: Float[Array, " m"]
    ) -> Accelerations:
        """Accelerations of all bodies at values of the inputs (m,)."""
        problem = self._held(values)
        model = at_internal(problem.model, internal) if problem.n_internal else problem.model
        return problem.method.formulation.accelerations(model, t, state, Unstabilised())

    def _held(self, values: Float[Array, " m"]) -> Problem:
        system = self.inputs.applied(self.problem.model.system, values)
        return eqx.tree_at(lambda p: p.model.system, self.problem, system)


def _adaptively(problem: Problem, now: IntegrationState, t1: Float[Array, ""]) -> IntegrationState:
    """Integrate to t1 [s] by steps of the method's own control; after a failure, stay there."""
    fine = now.result == diffrax.RESULTS.successful
    found = landing(problem.solve(now, jnp.where(fine, t1, now.t), problem.method.adjoint))
    counts = Counts(
        now.counts.accepted + found.accepted,
        now.counts.rejected + found.rejected,
        found.controller_state[2],
    )
    return IntegrationState(
        t=found.t,
        y=found.y,
        step=found.controller_state[0],
        solver_state=found.solver_state,
        controller_state=found.controller_state,
        counts=counts,
        result=diffrax.RESULTS.where(fine, found.result, now.result),
    )


def check_steps(steps: int | None) -> None:
    """Raise `SettingError` unless the number of steps in a period is a whole number, or None."""
    if steps is not None and (isinstance(steps, bool) or steps != int(steps) or steps < 1):
        raise SettingError(
            f"The number of steps in a period must be a whole number from 1, or None for steps that "
            f"the method's tolerances choose, but it is {steps}."
        )


def usable_method(method: Method | None, steps: int | None) -> Method:
    """Method for the steps of a plant; nothing bounds steps of a fixed length for derivatives."""
    if method is None:
        solver: Any = diffrax.Dopri8() if steps is None else RungeKutta4()
        return usable_method(Method(solver=solver), steps)
    if method.event is not None or method.jump_ts is not None:
        raise SettingError("A plant's method can have neither an event nor times of jumps.")
    adjoint = method.adjoint
    if isinstance(adjoint, DiscreteAdjoint):
        adjoint = diffrax.RecursiveCheckpointAdjoint()
    how = "state" if steps is not None else method.steps
    return dataclasses.replace(method, adjoint=adjoint, steps=how)
