"""Trim of any mechanism: inputs and states of a steady motion.

The unknowns z are the inputs that may be chosen, the states that may differ from those given,
and the internal states of force elements. The equations are

    du/dt (z) = a,   dz_f/dt (z) = 0,   g(z) = 0,

with the target accelerations a of the independent velocities, zero for an equilibrium, and further
conditions g on the motion of the bodies. Where there are more unknowns than equations, the solution
is the one nearest to the start, in the unknowns' sizes; it satisfies z - z_0 = J^T lambda beside the
equations. Derivatives are those of the implicit function: with r(z, q) = 0, dz/dq = -r_z^-1 r_q.

A mechanism with a floating base flies steadily (`trim_condition`): hover, climb, cruise or turn. Roll
and pitch of its base are unknowns, and everything revolves about the vertical,

    R = R_z(yaw) R_y(pitch) R_x(roll),    omega = rate R^T z.

Source: B. L. Stevens, F. L. Lewis, E. N. Johnson, Aircraft Control and Simulation (2016), ch. 3.6.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..checks.errors import ModelError, SettingError, StateError, has_values
from ..checks.numbers import array_module, as_floats, as_numpy, check_numbers
from ..checks.shapes import Numbers
from ..dynamics.actuation import (
    WEAK,
    effort_unit,
    force_units,
    input_labels,
    input_scales,
    names_of_largest,
)
from ..dynamics.formulations.independence import DEPENDENT
from ..dynamics.statespace.base import AbstractStateSpace, Time, check_regular, places_of
from ..dynamics.statespace.selection import BASE
from ..dynamics.statespace.tree import TreePoint
from ..dynamics.tree.topology import spanning_tree
from ..math import lapack
from ..math.compiler import kept_jit
from ..math.newton import Implicit, NearestNewton, Newton
from ..math.rotation import product, rotation_matrix, turn_about
from ..math.space import Point
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.internal import with_internal
from ..mechanics.size import mechanism_size, mechanism_weight
from ..mechanics.state import State
from ..mechanics.system import System

Conditions = Callable[[State], Float[Array, " c"]]

# Largest residual that counts as a trim [m/s^2], [rad/s^2].
TOLERANCE = 1e-10
# Inputs beyond this many times the mechanism's weight, or weight times size, are noted.
LARGE = 100.0
_MOST_STEPS = 50
# Part of a limit by which round-off may exceed it.
_LIMIT_ROUND_OFF = 1e-9
_UP = np.array([0.0, 0.0, 1.0])


class Trim(eqx.Module):
    """Result of a trim calculation: a steady motion, or NaN where none was found.

    Attributes:
        point: point of the state space.
        values: values of the inputs (m,).
        residuals: differences from the target accelerations, rates of the forces' states, and further
            conditions (e,), in `residual_units`.
        conditioning: smallest over largest singular value of the Jacobian with scaled unknowns;
            near zero, other trims are close. The ratio does not reveal inputs that all lose their effect: see
            `notes`.
        converged: true if the residual is below `TOLERANCE`; point and values are NaN otherwise.
        steps: number of steps of Newton's method.
        inputs: names and units of the values.
        input_scales: the mechanism's weight [N] for inputs in N, times its size [N m] for those in
            N m, one for others (m,).
        effect: accelerations of the independent coordinates, in g and those of angles times the size, by
            inputs of one scale (dof, m).
        labels, coordinates: names of the inputs with what they act on, and of the coordinates.
        units: unit of each input, "N", "N m" or "" for another one.
        residual_units: unit of each residual.
    """

    point: Point
    values: Float[Array, " m"]
    residuals: Float[Array, " e"]
    conditioning: Float[Array, ""]
    converged: Bool[Array, ""]
    steps: Int[Array, ""]
    inputs: Inputs
    input_scales: Float[Array, " m"]
    effect: Float[Array, "dof m"]
    labels: tuple[str, ...] = eqx.field(static=True)
    coordinates: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    residual_units: tuple[str, ...] = eqx.field(static=True)

    @property
    def residual(self) -> Float[Array, "*n"]:
        """Largest of the residuals, each in its unit."""
        return jnp.max(jnp.abs(self.residuals), axis=-1)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences on inputs that are large compared with the weight, and on inputs with little effect.

        A note names inputs above `LARGE` times the weight (for moments, times the weight and the size), and says where
        the smallest singular value of `effect` falls below `WEAK`: a direct singularity (type 2) is near.
        For a single trim, not for a stack. A trim that was not found has no notes.
        """
        sentences = []
        if not bool(self.converged):
            return ()
        values, scales = np.asarray(self.values), np.asarray(self.input_scales)
        for k, unit in enumerate(self.units):
            if unit and abs(values[k]) > LARGE * scales[k]:
                scale = "weight" if unit == "N" else "weight times size"
                sentences.append(
                    f"The input {self.labels[k]} is {values[k]:.4g} {unit}, {abs(values[k]) / scales[k]:.2g} "
                    f"times the mechanism's {scale} of {scales[k]:.4g} {unit}: the posture may be near an "
                    "actuation singularity."
                )
        columns = [k for k, unit in enumerate(self.units) if unit]
        effect = np.asarray(self.effect)[:, columns]
        if effect.size and np.all(np.isfinite(effect)):
            motions, singular, shares = np.linalg.svd(effect, full_matrices=False)
            # Motions that no input reaches at all, as of passive joints, are no warning: the
            # weakest of the reachable ones is.
            rank = int(np.sum(singular > DEPENDENT * singular[0]))
            if rank and singular[rank - 1] < WEAK:
                labels = [self.labels[k] for k in columns]
                acting = ", ".join(names_of_largest(labels, shares[rank - 1]))
                moving = ", ".join(names_of_largest(list(self.coordinates), motions[:, rank - 1]))
                sentences.append(
                    f"The inputs {acting} hardly accelerate {moving}: the smallest singular value of "
                    f"accelerations in g by inputs in weights is {singular[rank - 1]:.2g}, below {WEAK:g}; a "
                    "direct singularity (type 2) is near."
                )
        return tuple(sentences)


def find_largest_residuals(residuals: Numbers, units: Sequence[str]) -> dict[str, float]:
    """Largest absolute residual of each unit."""
    values, labels = np.abs(np.asarray(residuals)), np.asarray(units)
    return {unit: float(np.max(values[labels == unit])) for unit in dict.fromkeys(units)}


def format_residuals(residuals: Numbers, units: Sequence[str]) -> str:
    """Text with the largest absolute residual of each unit."""
    largest = find_largest_residuals(residuals, units)
    return ", ".join(f"{value:.1e} {unit}".removesuffix(" 1") for unit, value in largest.items())


class _FreeStates(eqx.Module):
    """Point whose named states have moved from the start: by components of an error of the space."""

    space: AbstractStateSpace
    places: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, start: Point, changes: Float[Array, " f"]) -> Point:
        if not self.places:
            return start
        v = jnp.zeros(self.space.size, changes.dtype)
        return self.space.retract(start, v.at[np.array(self.places, dtype=int)].set(changes))


Displace = Callable[[Point, Float[Array, " f"]], Point]


class _Problem(eqx.Module):
    """Data of the equations of a trim, in unknowns z = (states, inputs) of order one, zero at the start.

    The point is displace(start, sizes z_states); the inputs are values + directions z_inputs, where a
    vector of directions (m,) stands for a diagonal matrix.
    """

    space: AbstractStateSpace
    displace: Displace
    start: Point
    inputs: Inputs
    values: Float[Array, " m"]
    directions: Float[Array, " m"] | Float[Array, "m k"]
    target: Float[Array, " dof"]
    sizes: Float[Array, " f"]
    t: Float[Array, ""]
    conditions: Conditions | None

    @property
    def unknowns(self) -> int:
        """The number of unknowns."""
        return self.sizes.shape[0] + self.directions.shape[-1]

    def at(self, z: Float[Array, " k"]) -> tuple[Point, Float[Array, " m"]]:
        """Point and inputs at unknowns z."""
        count = self.sizes.shape[0]
        point = self.displace(self.start, self.sizes * z[:count])
        D, u = self.directions, z[count:]
        return point, self.values + (D * u if D.ndim == 1 else D @ u)

    def equations(self, z: Float[Array, " k"]) -> Float[Array, " e"]:
        """Accelerations less their targets, the rates of the forces' states, and the conditions."""
        x, values = self.at(z)
        system = self.inputs.applied(self.without_limits(), values)
        # Only accelerations and states of forces are equations: velocities are what the flight
        # prescribes, and need not be zero.
        rates = self.space.rates(x, self.t, system)[self.space.dof :]
        residual = rates - jnp.concatenate([self.target, jnp.zeros(len(rates) - self.space.dof)])
        if self.conditions is None:
            return residual
        return jnp.concatenate([residual, self.conditions(self.space.to_state(x, self.t))])

    @property
    def limited(self) -> tuple[int, ...]:
        """Places of the forces whose inputs are chosen and that have a limit."""
        chosen = sorted({entry.force for entry in self.inputs.entries})
        forces = self.space.system.forces
        return tuple(k for k in chosen if getattr(forces[k], "limit", None) is not None)

    def without_limits(self) -> System:
        """System whose chosen inputs give any force: beyond a limit Newton's method would have no slope."""
        system = self.space.system
        for k in self.limited:
            system = eqx.tree_at(lambda s, k=k: s.forces[k].limit, system, None)
        for k in {entry.force for entry in self.inputs.entries}:
            if getattr(system.forces[k], "squared_limits", None) is not None:
                system = eqx.tree_at(lambda s, k=k: s.forces[k].squared_limits, system, None)
        return system

    def efforts(self, z: Float[Array, " k"]) -> Float[Array, " l"]:
        """Efforts of the limited forces at unknowns z, in units of their limits."""
        x, values = self.at(z)
        system = self.inputs.applied(self.without_limits(), values)
        if isinstance(x, TreePoint) and x.internal.shape[0]:
            system = with_internal(system, x.internal)
        kin = system.kinematics(self.space.to_state(x, self.t))
        ratios = []
        for k in self.limited:
            force: Any = system.forces[k]
            limited: Any = self.space.system.forces[k]
            now = force.coordinate_at(kin)
            ratios.append(force.law(now.value, now.rate, self.t) / limited.limit)
        return jnp.stack(ratios) if ratios else jnp.zeros(0)

    def count(self) -> int:
        """The number of equations, found without tracing the motion."""
        rates = self.space.size - self.space.dof
        if self.conditions is None:
            return rates
        state = self.space.system.reference
        return rates + eqx.filter_eval_shape(self.conditions, state).shape[0]


def _evaluate_equations(z: Float[Array, " k"], problem: _Problem) -> Float[Array, " e"]:
    return problem.equations(z)


def _nearest_equations(both: Float[Array, " k"], problem: _Problem) -> Float[Array, " k"]:
    """Equations of the nearest trim: those of the trim, and z along the rows of their Jacobian."""
    count = problem.unknowns
    z, multipliers = both[:count], both[count:]
    # The nearest trim minimises |z|^2 under the equations: its conditions, z = J^T multipliers and
    # r = 0, are solved together by Newton's method.
    residuals, pullback = jax.vjp(problem.equations, z)
    return jnp.concatenate([z - pullback(multipliers)[0], residuals])


@kept_jit
def _solve_equations(problem: _Problem) -> tuple[Any, ...]:
    """Solve for the unknowns; also residual, conditioning, steps, the inputs' scales, effect and efforts."""
    count, rows = problem.unknowns, problem.count()
    square = count == rows
    atol = 0.1 * TOLERANCE
    newton: Any = (
        Newton(atol)  # pyright: ignore[reportCallIssue]
        if square
        else NearestNewton(_evaluate_equations, count, atol)  # pyright: ignore[reportCallIssue]
    )
    solution = optx.root_find(
        _evaluate_equations if square else _nearest_equations, newton, jnp.zeros(count if square else count + rows),
        args=problem, adjoint=Implicit(), max_steps=_MOST_STEPS, throw=False,
    )  # fmt: skip
    # Jacobian and residual of the last step are at hand: conditioning and the inputs' effect cost
    # no further evaluation, and have no derivative.
    last = jax.lax.stop_gradient(solution.state)
    values = lapack.singular_values(last.J)
    # accelerations by inputs, in the scales of the mechanism's weight and size
    space = problem.space
    weight = mechanism_weight(space.system)
    size = mechanism_size(space.system, space.system.reference)
    scales = input_scales(space.system, problem.inputs, weight, size)
    lengths = [
        size if unit == "rad" else jnp.ones_like(size) for _, unit in space.names[: space.dof]
    ]
    columns, D = last.J[: space.dof, problem.sizes.shape[0] :], problem.directions
    columns = columns / D[None] if D.ndim == 1 else columns @ lapack.solve(D.T @ D, D.T)
    g = weight / jnp.sum(space.system.bodies.mass)
    effect = jnp.stack(lengths)[:, None] * columns * scales[None] / g if lengths else columns
    conditioning, steps = values[-1] / values[0], solution.stats["num_steps"]
    z = solution.value[:count]
    measures = last.r, conditioning, steps, scales, effect, problem.efforts(z)
    return z, *jax.lax.stop_gradient(measures)


def trim(
    space: AbstractStateSpace,
    *,
    at: Point,
    free: Sequence[str] = (),
    inputs: Inputs | None = None,
    values: Numbers | None = None,
    accelerations: Numbers | None = None,
    conditions: Conditions | None = None,
    sizes: Numbers | None = None,
    directions: Numbers | None = None,
    t: Time = 0.0,
    throw: bool = True,
) -> Trim:
    """Inputs and free states at which a mechanism moves steadily.

    The function is pure: it may be jitted, vmapped, and differentiated in all arguments.

    Args:
        space: state space of the mechanism.
        at: point at which the search starts; its states are kept except the free ones.
        free: names of states that may be changed.
        inputs: inputs that may be chosen; default all of the system. Others stay as they are.
        values: inputs at the start of the search (m,); default those that the system has.
        accelerations: target rates of the independent velocities (dof,); default zero.
        conditions: function of positions and velocities of all bodies -> further residuals (c,), to
            be met by free states; a module or function made once, since it is compiled in.
        sizes: changes of the unknowns that count as equally far from the start, free states first,
            then inputs (k,); default one for states, and for inputs their starts or one.
        directions: combinations of inputs that may be chosen (m, d), such as those of minimum norm for a
            wrench; `sizes` are then those of the states and of the d combinations, which are one by
            default. Default: every input by itself.
        t: time [s], where forces or joints depend on it.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: no trim was found, it needs more than the limit of an actuator or of a rotor's speed, or
            the posture is singular for the independent coordinates.
        SettingError: an unknown name, or fewer unknowns than equations.
        ModelError: numbers of another shape, or not finite.
    """
    # States of forces, such as motors' speeds, settle with the inputs and are always unknowns.
    chosen = (*places_of(space, free, "The free states"), *range(2 * space.dof, space.size))
    if len(set(chosen)) < len(chosen):
        raise SettingError(
            "The free states of a trim must not name states of forces, which are always free: leave them out."
        )
    return _solve_trim(
        space, _FreeStates(space, chosen), len(chosen), free, at, inputs=inputs, values=values,
        accelerations=accelerations, conditions=conditions, sizes=sizes, directions=directions, t=t,
        throw=throw,
    )  # fmt: skip


def _solve_trim(
    space: AbstractStateSpace, displace: Displace, states: int, free: Sequence[str], start: Point, *,
    inputs: Inputs | None, values: Numbers | None, accelerations: Numbers | None,
    conditions: Conditions | None, sizes: Numbers | None, directions: Numbers | None, throw: bool,
    t: Time = 0.0,
) -> Trim:  # fmt: skip
    """Trim whose states follow from `states` unknowns by `displace`; see `trim`."""
    inputs = inputs_of(space.system) if inputs is None else inputs
    m = len(inputs)
    start_values = inputs.values(space.system) if values is None else values
    start_values = check_numbers(start_values, (m,), "The vector of the inputs to start from", "")
    target = jnp.zeros(space.dof) if accelerations is None else accelerations
    target = check_numbers(target, (space.dof,), "The vector of target accelerations", "")
    if directions is None:
        columns = jnp.ones(m)
        # Unknowns are scaled to their sizes: squared rotor speeds of 1e6 and angles of 0.1 in one system
        # would leave Newton's method with a condition of 1e14.
        scales = jax.lax.stop_gradient(jnp.where(start_values == 0, 1.0, jnp.abs(start_values)))
    else:
        shape = (m, np.shape(directions)[-1])
        columns = check_numbers(directions, shape, "The inputs' directions", "")
        scales = jnp.ones(columns.shape[1])
    state_sizes = jnp.ones(states)
    if sizes is not None:
        count = states + columns.shape[-1]
        sizes = check_numbers(sizes, (count,), "The vector of the unknowns' sizes", "")
        state_sizes, scales = sizes[:states], sizes[states:]
    # At a singular posture the independent coordinates do not determine the others, and the equations
    # below have no meaning.
    check_regular(space, start, t)
    problem = _Problem(
        space, displace, start, inputs, start_values, columns * scales, target, state_sizes,
        jnp.asarray(t, dtype=float), conditions,
    )  # fmt: skip
    chosen = ", ".join([*free, *(name for name, _ in inputs.names)])
    if problem.unknowns < problem.count():
        raise SettingError(
            f"A trim has {problem.count()} equations here, one for every independent velocity, every "
            f"state of a force and every condition, but only {problem.unknowns} unknowns "
            f"({chosen or 'none'}): add inputs, or name free states among "
            f"{', '.join(name for name, _ in space.names[: 2 * space.dof])}."
            + _suggest_free_states(space, inputs, free)
        )
    z, residuals, conditioning, steps, weights, effect, efforts = _solve_equations(problem)
    residual = jnp.max(jnp.abs(residuals))
    rates = [f"{unit}^2" if unit.endswith("/s") else f"{unit}/s" for _, unit in space.names]
    units = (*rates[space.dof :], *["1"] * (residuals.shape[-1] - space.size + space.dof))
    # A point that did not converge is returned as NaN and never as a guess that looks like a trim.
    converged = residual <= TOLERANCE
    if throw and has_values(efforts) and bool(converged):
        for k, ratio in zip(problem.limited, np.asarray(efforts), strict=True):
            force: Any = space.system.forces[k]
            limit = float(force.limit)
            if abs(ratio) > 1 + _LIMIT_ROUND_OFF:
                unit = effort_unit(space.system, force.joint, force.coordinate)
                raise StateError(
                    f"The trim needs an effort of {ratio * limit:.6g} {unit} of the {type(force).__name__} in joint "
                    f"'{force.joint}', but its limit is {limit:.6g}: raise the limit, or choose another posture."
                )
    converged = converged & jnp.all(jnp.abs(efforts) <= 1 + _LIMIT_ROUND_OFF)
    if throw and has_values(residual) and not bool(converged):
        hint = ""
        is_finite = np.isfinite(residual)
        residual_text = format_residuals(residuals, units) if is_finite else "that are not finite"
        if not float(conditioning) > 1e-12:
            hint = (
                " The equations are singular there: these unknowns do not reach all accelerations."
                + _suggest_free_states(space, inputs, free)
            )
        raise StateError(
            "No trim was found near the start: Newton's method stopped with residual accelerations "
            f"{'of ' * bool(is_finite)}{residual_text} (tolerance {TOLERANCE:.0e}) over the unknowns {chosen}.{hint}"
        )
    point, trim_values = problem.at(z)
    # squared speeds of rotors with limits, with a margin for round-off
    pairs = []
    for entry in inputs.entries:
        limits: Any = getattr(space.system.forces[entry.force], "squared_limits", None)
        low, high = (-jnp.inf, jnp.inf) if limits is None else (x[entry.place] for x in limits)
        pairs.append((low * (1 - _LIMIT_ROUND_OFF), high * (1 + _LIMIT_ROUND_OFF)))
    lowest, highest = (jnp.array([pair[k] for pair in pairs]) for k in (0, 1))
    if throw and has_values(trim_values, lowest, highest):
        numbers = (np.asarray(x).tolist() for x in (trim_values, lowest, highest))
        for entry, value, low, high in zip(inputs.entries, *numbers, strict=True):
            if not low <= value <= high:
                text = f"{np.sqrt(value):.6g} rad/s" if value >= 0 else "a thrust downwards"
                raise StateError(
                    f"The trim needs {text} of the rotor with the input '{entry.name}', but its limits are "
                    f"{np.sqrt(low):.6g} to {np.sqrt(high):.6g} rad/s."
                )
    converged = converged & jnp.all((trim_values >= lowest) & (trim_values <= highest))
    keep = lambda tree: jax.tree.map(lambda x: jnp.where(converged, x, jnp.nan), tree)
    point, trim_values = keep((point, trim_values))
    return Trim(
        point, trim_values, residuals, conditioning, converged, steps, inputs, weights, effect,
        tuple(input_labels(space.system, inputs)),
        tuple(name for name, _ in space.names[: space.dof]),
        force_units(space.system, inputs), units,
    )  # fmt: skip


def _suggest_free_states(space: AbstractStateSpace, inputs: Inputs, free: Sequence[str]) -> str:
    """Sentence on the coordinates of joints without an input, whose posture a trim usually has to find."""
    forces: Any = space.system.forces
    driven = {getattr(forces[entry.force], "joint", None) for entry in inputs.entries}
    names = [
        name
        for name, _ in space.names[: space.dof]
        if "." in name and name.rpartition(".")[0] not in driven and name not in free
    ]
    listed = ", ".join(names)
    return (
        f" No input acts in the joint of {listed}: a free state usually is one of these."
        if names
        else ""
    )


# --- steady flight


class FlightCondition(NamedTuple):
    """A steady flight; see `hover`, `climb`, `cruise` and `steady_turn`.

    Attributes:
        angles: panel angles of the UAV (2,) [rad], or None where it points at the sun.
        sun: direction to the sun, world (3,), or None.
        yaw: heading [rad]. v: velocity of the base, world (3,) [m/s].
        rate: rate of turn about the vertical [rad/s].
        acceleration: acceleration of the base in addition to that of the turn, world (3,) [m/s^2].
    """

    angles: Float[Array, "2"] | None
    sun: Float[Array, "3"] | None
    yaw: Float[Array, ""]
    v: Float[Array, "3"]
    rate: Float[Array, ""]
    acceleration: Float[Array, "3"]


def hover(angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> FlightCondition:
    """Standing still with the panel at angles (2,) [rad], or at the sun (3,), world.

    A machine without a panel needs neither; see `trim_condition`.

    Raises:
        ModelError: arguments that are not finite or of another shape, or not exactly one of angles
            and sun (here and in the functions below).
    """
    return _make_condition(angles, sun, yaw, jnp.zeros(3), 0.0)


def climb(speed: Any, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> FlightCondition:
    """Straight up at a speed [m/s]; negative for a descent."""
    speed = check_numbers(speed, (), "The speed of the climb", "m/s")
    return _make_condition(angles, sun, yaw, as_floats(as_numpy(speed) * _UP), 0.0)


def cruise(
    speed: Any, course: Any = 0.0, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None
) -> FlightCondition:
    """Level flight at a speed [m/s] towards a course from x to y [rad]."""
    speed = check_numbers(speed, (), "The level speed", "m/s")
    course = check_numbers(course, (), "The course", "rad")
    module, (speed, course) = array_module(speed, course), as_numpy((speed, course))
    course_direction = module.stack(
        [module.cos(course), module.sin(course), module.zeros_like(course)]
    )
    return _make_condition(angles, sun, yaw, as_floats(speed * course_direction), 0.0)


def steady_turn(
    speed: Any, rate: Any, angles: Any = None, course: Any = 0.0, yaw: Any = 0.0
) -> FlightCondition:
    """A level turn at a speed [m/s] and a rate [rad/s], positive from x to y; at its start."""
    straight = cruise(speed, course, angles, yaw)
    return straight._replace(rate=check_numbers(rate, (), "The rate of turn", "rad/s"))


class _Attitude(eqx.Module):
    """Point of a steady flight whose base has turned by roll and pitch, and whose free states have moved."""

    free: _FreeStates
    yaw: Float[Array, ""]
    rate: Float[Array, ""]

    def __call__(self, start: Point, changes: Float[Array, " f"]) -> Point:
        roll, pitch = changes[:2]
        # Roll and pitch are unknowns while heading is given: in still air a trim exists at every heading, and
        # a free heading would make the equations singular.
        p = product(turn_about(self.yaw, 2), product(turn_about(pitch, 1), turn_about(roll, 0)))
        # In a steady turn the base rotates about the vertical, whose components in body axes change with roll
        # and pitch.
        omega = self.rate * rotation_matrix(p)[2]
        return self.free(start._replace(p=p, omega=omega), changes[2:])


class _Pointing(eqx.Module):
    """Condition that a direction in a body points at the sun: its components across the sun's vanish."""

    sun: Float[Array, "3"]
    axis: Float[Array, "3"]
    body: int = eqx.field(static=True)

    def __call__(self, state: State) -> Float[Array, "2"]:
        # Two components across the sun's direction vanish when the panel faces it; the angle itself has no
        # derivative there.
        s = self.sun / jnp.sqrt(self.sun @ self.sun)
        other = jnp.where(jnp.abs(s[0]) < 0.7, jnp.array([1.0, 0, 0]), jnp.array([0.0, 1.0, 0]))
        across = jnp.cross(s, other)
        n = rotation_matrix(state.p[self.body]) @ self.axis
        return jnp.stack([across @ n, jnp.cross(s, across) @ n])


def trim_condition(
    space: AbstractStateSpace,
    condition: FlightCondition,
    *,
    at: Point,
    free: Sequence[str] = (),
    inputs: Inputs | None = None,
    values: Numbers | None = None,
    sizes: Numbers | None = None,
    directions: Numbers | None = None,
    pointing: str | None = None,
    axis: Numbers = (0.0, 0.0, 1.0),
    throw: bool = True,
) -> Trim:
    """Attitude and inputs of a steady flight of any mechanism with a floating base; see `trim`.

    Args:
        condition: flight without panel angles: joints stay as they are in `at`.
        at: posture from which the search starts, with the base level and at the heading.
        free: names of further states that may be changed; with the sun at least two, such as the
            coordinates of the panel's joints.
        inputs, values, directions: inputs that may be chosen; see `trim`.
        sizes: sizes of the unknowns: roll and pitch, free states, then inputs.
        pointing: name of the body that points at the sun. axis: direction that does, body axes (3,).

    Raises:
        SettingError: nothing floats, angles of a panel, or a sun without a body that points at it.
        And as `trim`.
    """
    tree = spanning_tree(space.system)
    if not tree.floating or space.names[:6] != BASE[:6]:
        raise SettingError(
            "A flight needs a mechanism with a floating base: declare one body free."
        )
    if condition.angles is not None:
        raise SettingError(
            "Panel angles are for the tracker: give the posture of the joints in `at`."
        )
    if (condition.sun is None) != (pointing is None):
        raise SettingError("Pointing at the sun needs its direction and the name of a body.")
    # Two further equations, the components across the sun's direction, take two further unknowns,
    # such as the panel's joints.
    towards = None
    if pointing is not None:
        axis = check_numbers(axis, (3,), "The axis that points at the sun", "")
        assert condition.sun is not None
        towards = _Pointing(condition.sun, axis, space.system.index(pointing))
    of_forces = range(2 * space.dof, space.size)
    chosen = (*places_of(space, free, "The free states"), *of_forces)
    displace = _Attitude(_FreeStates(space, chosen), condition.yaw, condition.rate)
    # The velocity is given: drag and the turn's acceleration follow from it.
    start = displace(at._replace(v=condition.v), jnp.zeros(2 + len(chosen)))
    # acceleration of the base: that of the turn plus that of the condition
    x, y, _ = condition.v
    turning = condition.rate * jnp.stack([-y, x, jnp.zeros_like(x)]) + condition.acceleration
    return _solve_trim(
        space, displace, 2 + len(chosen), ["roll", "pitch", *free], start, inputs=inputs, values=values,
        accelerations=jnp.zeros(space.dof).at[:3].set(turning),
        conditions=towards, sizes=sizes, directions=directions, throw=throw,
    )  # fmt: skip


def _make_condition(angles: Any, sun: Any, yaw: Any, v: Array, rate: Any) -> FlightCondition:
    if angles is not None and sun is not None:
        raise ModelError(
            "A flight needs either the panel's angles or the direction to the sun, and not both."
        )
    if angles is not None:
        angles = check_numbers(angles, (2,), "The pair of the panel's angles", "rad")
    if sun is not None:
        sun = check_numbers(sun, (3,), "The direction to the sun", "")
        if has_values(sun) and not np.linalg.norm(np.asarray(sun)) > 0:
            raise ModelError("The direction to the sun must not be zero.")
    yaw = check_numbers(yaw, (), "The heading", "rad")
    return FlightCondition(angles, sun, yaw, v, as_floats(rate), as_floats(np.zeros(3)))
