"""Integration method: formulation, solver, tolerances and further settings."""

import dataclasses
from functools import partial
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError, concrete, nearest_names
from ..checks.shapes import Numbers
from .choices import FIRST_STEP, STEP_TOLERANCE, STEPS_ALLOWED
from .formulations.augmented import Augmented
from .formulations.base import AbstractFormulation
from .formulations.stabilisation import AbstractStabilisation, Baumgarte, Projection, Unstabilised
from .integration.adjoint import DiscreteAdjoint
from .integration.problem import AbstractMethod, Event
from .integration.rosenbrock import Rodas5P
from .tree.formulation import Tree

# Base class of each part, and the classes that an error message names.
_PARTS: dict[str, tuple[type, tuple[type, ...]]] = {
    "formulation": (AbstractFormulation, (Tree, Augmented)),
    "solver": (diffrax.AbstractSolver, (diffrax.Dopri8, diffrax.Tsit5, Rodas5P)),
    "stabilisation": (AbstractStabilisation, (Projection, Baumgarte, Unstabilised)),
}


def _part(name: str, given: Any) -> Any:
    """Check that a formulation, solver or stabilisation is an object of that kind; return it.

    Raises:
        SettingError: it is a text or a class, or an object of another kind; says what to write.
    """
    kind, known = _PARTS[name]
    automatic = name == "solver"
    if isinstance(given, kind) or (automatic and isinstance(given, str) and given == "auto"):
        return given
    names = [each.__name__ for each in known]
    valid = ", ".join(f"{each}()" for each in names) + (', or "auto"' * automatic)
    if isinstance(given, str):
        meant = [each for each in names if each.lower() == given.lower()]
        hint = f": write {meant[0]}()." if meant else f".{nearest_names(given, names)}"
        what = f"the text '{given}'{hint}"
    elif isinstance(given, type):
        what = f"the class {given.__name__}: write {given.__name__}()."
    else:
        what = f"of type {type(given).__name__}."
    raise SettingError(f"{name} must be an object such as {valid}, but it is {what}")


def described(part: Any) -> dict[str, Any]:
    """Name of the class of a method's part, and those of its fields that are numbers or texts."""
    fields = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    plain = {k: v for k, v in fields.items() if isinstance(v, str | None)}
    numbers = {k: np.asarray(v).tolist() for k, v in fields.items() if eqx.is_array_like(v)}
    return {"kind": type(part).__name__} | plain | numbers


def _times(given: Any) -> Any:
    """Times as one array (j,), which may be given as a list; None stays None."""
    return None if given is None else jnp.asarray(given, dtype=float)


class Method(AbstractMethod):
    """Complete settings of an integration, apart from the system, its state and the output times.

    Args:
        formulation: formulation of the equations of motion.
        solver: any diffrax solver with an error estimate. `Rodas5P()` is for stiff systems; for
            `simulate`, which knows the initial state, the text "auto" applies `choose_solver`.
        rtol, atol: tolerances of a step, on positions [m], Euler parameters, velocities
            [m/s] and angular velocities [rad/s] alike.
        stabilisation: stabilisation of the constraints.
        first_step: length of the first step [s].
        max_steps: accepted and rejected steps between two output times.
        adjoint: reverse-mode derivatives: any adjoint of diffrax, or the default, a
            `DiscreteAdjoint`. An explicit method without events then keeps accepted steps with
            their slopes and goes back through them; a longer run is kept in windows whose steps
            are taken again on the way back. Anything else is differentiated by diffrax's
            `RecursiveCheckpointAdjoint`, which takes adaptive steps again; they then differ by
            round-off in their sizes, which costs a gradient digits.
        event: (t, state) -> a number whose change of sign ends the integration, at that
            time; or a truth value, which ends it after the first step that makes it true. A run
            that starts where the number is zero starts after that event. An `equinox.Module`
            with numbers as leaves is not compiled again for other numbers. A value of
            NaN ends the run with the result `diffrax.RESULTS.nonfinite`.
        direction: direction of the event's change of sign: True up, False down, None both.
        jump_ts: times at which forces jump (j,) [s]. A step ends just before each, and the
            next begins just after it; a force is not evaluated at the jump itself.
        balances: integrate work and impulse beside the state, for the balances of energy
            and momentum; it adds about a tenth to the computing time.
        steps: control of the step lengths. "sensitivities", the default: besides the state's error
            estimate, the modes of the linearised motion bound them, so that derivatives with
            respect to the start and to constant numbers are as accurate at rest as in
            motion; see `integration.step_bound`. It takes eleven more right-hand sides every
            twelve steps. "state": the error estimate alone, for runs that nobody differentiates.
        max_step: largest step [s]. It makes derivatives accurate with respect to inputs that are
            zero in the run itself but would vary faster than the system does.

    Raises:
        SettingError: a formulation, solver or stabilisation is a text, a class, or an object of
            another kind; or a tolerance, a step or a number of steps is out of range. Numbers
            that JAX traces are not checked.
    """

    formulation: AbstractFormulation = eqx.field(
        converter=partial(_part, "formulation"), default=Tree()
    )
    solver: diffrax.AbstractSolver | Literal["auto"] = eqx.field(
        converter=partial(_part, "solver"), default=diffrax.Dopri8()
    )
    rtol: float | Float[Array, ""] = STEP_TOLERANCE
    atol: float | Float[Array, ""] = STEP_TOLERANCE
    stabilisation: AbstractStabilisation = eqx.field(
        converter=partial(_part, "stabilisation"), default=Projection()
    )
    first_step: float | Float[Array, ""] = FIRST_STEP
    max_steps: int = eqx.field(static=True, default=STEPS_ALLOWED)
    adjoint: diffrax.AbstractAdjoint = DiscreteAdjoint()
    event: Event | None = None
    direction: bool | None = eqx.field(static=True, default=None)
    jump_ts: Numbers | None = eqx.field(converter=_times, default=None)
    balances: bool = eqx.field(static=True, default=False)
    steps: Literal["sensitivities", "state"] = eqx.field(static=True, default="sensitivities")
    max_step: float | Float[Array, ""] = float("inf")

    def __check_init__(self) -> None:
        if self.max_steps < 1:
            raise SettingError(f"max_steps must be at least 1, but it is {self.max_steps}.")
        if not concrete(self.rtol, self.atol, self.first_step, self.max_step):
            return
        for name in ("rtol", "atol"):
            value = float(getattr(self, name))
            if not (np.isfinite(value) and value >= 1e-15):
                raise SettingError(
                    f"{name} must be finite and at least 1e-15 (the round-off of double "
                    f"precision), but it is {value}."
                )
        first = float(self.first_step)
        if not (np.isfinite(first) and first > 0):
            raise SettingError(f"first_step must be finite and positive, but it is {first} s.")
        if not float(self.max_step) > 0:
            raise SettingError(f"max_step must be positive, but it is {self.max_step} s.")
