"""Integration method: formulation, solver, tolerances and further settings; stiffness and choice of a solver."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError, StateError, has_values, nearest_names
from ..checks.shapes import Numbers
from ..math.compiler import kept_jit
from ..math.native.program import native
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .choices import FIRST_STEP, STEP_TOLERANCE, STEPS_ALLOWED
from .formulations.augmented import Augmented
from .formulations.base import AbstractFormulation
from .formulations.stabilisation import AbstractStabilisation, Baumgarte, Projection, Unstabilised
from .integration.stepping import kvaerno5
from .tree.formulation import Tree

# Base class of each part, and the classes and functions that an error message names.
_PARTS: dict[str, tuple[type, tuple[Any, ...]]] = {
    "formulation": (AbstractFormulation, (Tree, Augmented)),
    "solver": (diffrax.AbstractSolver, (diffrax.Dopri8, diffrax.Tsit5, kvaerno5)),
    "stabilisation": (AbstractStabilisation, (Projection, Baumgarte, Unstabilised)),
}


def _check_part(name: str, part: Any) -> Any:
    """Check that a formulation, solver or stabilisation is an object of that kind; return it.

    Raises:
        SettingError: it is a text or a class, or an object of another kind; says what to write.
    """
    kind, class_choices = _PARTS[name]
    automatic = name == "solver"
    if isinstance(part, kind) or (automatic and isinstance(part, str) and part == "auto"):
        return part
    names = [choice.__name__ for choice in class_choices]
    valid = ", ".join(f"{choice}()" for choice in names) + (', or "auto"' * automatic)
    if isinstance(part, str):
        # Names as text are a common slip of users of other libraries; the message shows the object to write.
        meant = [choice for choice in names if choice.lower() == part.lower()]
        hint = f": write {meant[0]}()." if meant else f".{nearest_names(part, names)}"
        description = f"the text '{part}'{hint}"
    elif isinstance(part, type):
        description = f"the class {part.__name__}: write {part.__name__}()."
    else:
        description = f"of type {type(part).__name__}."
    raise SettingError(f"{name} must be an object such as {valid}, but it is {description}")


def describe_part(part: Any) -> dict[str, Any]:
    """Name of the class of a method's part, and those of its fields that are numbers or texts."""
    fields = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    plain = {k: v for k, v in fields.items() if isinstance(v, str | None)}
    numbers = {k: np.asarray(v).tolist() for k, v in fields.items() if eqx.is_array_like(v)}
    return {"kind": type(part).__name__} | plain | numbers


def _join_times(times: Any) -> Any:
    """Times as one array (j,), which may be given as a list; None stays None."""
    return None if times is None else jnp.asarray(times, dtype=float)


Event = Callable[[Float[Array, ""], State], Array]


class DiscreteAdjoint(diffrax.AbstractAdjoint):
    """Discrete adjoint: reverse-mode derivatives of the accepted steps as they were taken.

    In `integrate` an explicit method without an event is differentiated as `integration.adjoint` describes.
    With implicit methods, events, and in `diffrax.diffeqsolve` itself, the adjoint is diffrax's
    `RecursiveCheckpointAdjoint` with `recorded_steps` checkpoints, which takes adaptive steps again.

    Attributes:
        recorded_steps: step attempts of a window, whose slopes are in memory at a time, 64 by default; or number of
            checkpoints, by default 4,096 divided among the output times, at least 64 for each.

    Raises:
        SettingError: `recorded_steps` is less than one.
    """

    recorded_steps: int | None = None

    def __check_init__(self) -> None:
        if self.recorded_steps is not None and self.recorded_steps < 1:
            raise SettingError(
                f"A DiscreteAdjoint must record at least one step attempt, not {self.recorded_steps}."
            )

    def loop(self, **how: Any) -> Any:
        """Loop of `diffrax.diffeqsolve`, see there."""
        return diffrax.RecursiveCheckpointAdjoint(checkpoints=self.recorded_steps).loop(**how)


class Method(eqx.Module):
    """Complete settings of an integration, apart from the system, its state and the output times.

    Args:
        formulation: formulation of the equations of motion.
        solver: any diffrax solver with an error estimate. `kvaerno5()` is for stiff systems; for `simulate`,
            which has the initial state, the text "auto" applies `choose_solver`.
        rtol, atol: tolerances of a step, on positions [m], Euler parameters, velocities
            [m/s] and angular velocities [rad/s] alike.
        stabilisation: stabilisation of the constraints.
        first_step: length of the first step [s]; at most a hundredth of the run's time.
        max_steps: accepted and rejected steps between two output times; in reverse mode by a `DiscreteAdjoint`
            the record has room for at least as many to all of them together, and a run that takes more fails.
        adjoint: how a run is differentiated: the default, a `DiscreteAdjoint`, in reverse mode; diffrax's
            `ForwardMode`, `DirectAdjoint` (both modes) or `RecursiveCheckpointAdjoint`. An explicit method
            without events then records the times of accepted steps, and the backward pass takes them again
            window by window. Other methods use diffrax's `RecursiveCheckpointAdjoint`, which repeats adaptive
            steps; round-off changes their sizes, so that gradients are less accurate.
        event: (t, state) -> a number whose change of sign ends the integration, at that
            time; or a boolean, which ends it after the first step that makes it true. A run
            that starts where the number is zero starts after that event. An `equinox.Module`
            with numbers as leaves is not compiled again for other numbers. A value of
            NaN ends the run with the result `diffrax.RESULTS.nonfinite`.
        direction: direction of the event's change of sign: True up, False down, None both.
        jump_ts: times at which forces jump (j,) [s]. A step ends just before each, and the
            next begins just after it; a force is not evaluated at the jump itself.
        balances: integrate work and impulse with the state, for the balances of energy
            and momentum; it adds about a tenth to the computing time.
        steps: control of the step lengths. "sensitivities", the default: besides the state's error
            estimate, the modes of the linearised motion bound them, so that derivatives with
            respect to the start and to constant numbers are as accurate at rest as in
            motion; see `integration.stepping`. It takes eleven more right-hand sides every
            twelve steps. "state": the error estimate alone, for runs without derivatives.
        max_step: largest step [s]. It makes derivatives accurate with respect to inputs that are
            zero in the run itself but would vary faster than the system does.

    Raises:
        SettingError: a formulation, solver or stabilisation is a text, a class, or an object of
            another kind; an adjoint is one that runs do not support; or a tolerance, a step or a number of
            steps is out of range. Numbers that JAX traces are not checked.
    """

    formulation: AbstractFormulation = eqx.field(
        converter=partial(_check_part, "formulation"), default=Tree()
    )
    solver: diffrax.AbstractSolver | Literal["auto"] = eqx.field(
        converter=partial(_check_part, "solver"), default=diffrax.Dopri8()
    )
    rtol: float | Float[Array, ""] = STEP_TOLERANCE
    atol: float | Float[Array, ""] = STEP_TOLERANCE
    stabilisation: AbstractStabilisation = eqx.field(
        converter=partial(_check_part, "stabilisation"), default=Projection()
    )
    first_step: float | Float[Array, ""] = FIRST_STEP
    max_steps: int = eqx.field(static=True, default=STEPS_ALLOWED)
    adjoint: diffrax.AbstractAdjoint = DiscreteAdjoint()
    event: Event | None = None
    direction: bool | None = eqx.field(static=True, default=None)
    jump_ts: Numbers | None = eqx.field(converter=_join_times, default=None)
    balances: bool = eqx.field(static=True, default=False)
    steps: Literal["sensitivities", "state"] = eqx.field(static=True, default="sensitivities")
    max_step: float | Float[Array, ""] = float("inf")

    def __check_init__(self) -> None:
        if not isinstance(self.max_steps, int) or self.max_steps < 1:
            raise SettingError(
                f"max_steps must be a whole number of at least 1, but it is {self.max_steps}."
            )
        if isinstance(self.adjoint, diffrax.BacksolveAdjoint | diffrax.ImplicitAdjoint):
            raise SettingError(
                f"A run cannot be differentiated with adjoint={type(self.adjoint).__name__}(): use the default, "
                "DiscreteAdjoint(), or diffrax.RecursiveCheckpointAdjoint() in reverse mode, diffrax.ForwardMode() in "
                "forward mode, or diffrax.DirectAdjoint()."
            )
        if not has_values(self.rtol, self.atol, self.first_step, self.max_step):
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


# With servos explicit and implicit solvers take the same time near 430 1/s, and at 1400 1/s the
# implicit one is 1.9 times as fast: docs/simulation.md.
EXPLICIT_LIMIT = 1e3  # [1/s]


def spectrum(
    system: System,
    state: State,
    t: Numbers = 0.0,
    *,
    formulation: AbstractFormulation | None = None,
) -> np.ndarray:
    """Eigenvalues [1/s] of the motion linearised at a state, largest magnitude first, (k,).

    The coordinates are those of the formulation (default `Tree()`), so that constraints contribute
    zeros. Steps of an explicit method cannot be longer than a few divided by the first magnitude,
    whatever the tolerance; if that is far shorter than what the motion itself needs, the scene is
    stiff.

    Raises:
        SettingError: shapes or precision of the state do not fit the system.
        StateError: the derivatives are not finite at the state.
    """
    check_state(system, state)
    chosen_formulation = formulation if formulation is not None else Tree()
    # outside of the program, where the joints' geometry holds known numbers
    model: Any = chosen_formulation.prepare(system)
    matrix = np.asarray(_evaluate_jacobian(chosen_formulation, model, state, jnp.asarray(t, float)))
    if not np.all(np.isfinite(matrix)):
        raise StateError(
            "The motion cannot be linearised at this state: the accelerations or their derivatives "
            "are not finite. The state itself is not finite, or a force is discontinuous there, such "
            "as that of a spring with a rest length whose ends meet."
        )
    # The fastest eigenvalue decides whether the stability of an explicit method, and not its accuracy,
    # limits the steps.
    values = np.linalg.eigvals(matrix)
    return values[np.argsort(-np.abs(values))]


@kept_jit
def _evaluate_jacobian(
    formulation: AbstractFormulation, model: Any, state: State, t: Float[Array, ""]
) -> Float[Array, "k k"]:
    x = formulation.to_vector(model, state)
    return jax.jacfwd(lambda x: _get_rates(formulation, model, t, x))(x)


@native
def _get_rates(formulation: AbstractFormulation, model: Any, t: Any, x: Any) -> Any:
    return formulation.derivative(model, t, x, Unstabilised())[0]


def choose_solver(
    system: System,
    state: State,
    t: Numbers = 0.0,
    *,
    formulation: AbstractFormulation | None = None,
) -> diffrax.AbstractSolver:
    """`kvaerno5()` if the largest |eigenvalue| at the state exceeds `EXPLICIT_LIMIT`, else `Dopri8()`.

    Only the given state is evaluated, which misleads if a system is stiff only briefly: an end stop that is
    reached later is not detected, and friction is stiff at rest but not in motion.
    """
    fastest = np.abs(spectrum(system, state, t, formulation=formulation)[0])
    return kvaerno5() if fastest > EXPLICIT_LIMIT else diffrax.Dopri8()
