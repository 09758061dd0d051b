"""Reaction loads for the sizing of joints: histories, envelopes and peaks.

A reaction is the load of body i on body j at a joint: force, and moment about the joint's point on
body j, in the axes of the joint's frame fixed in body i (z along the joint's axis, if it has one).
Loads along one or many time histories can be differentiated, and mapped over runs. Peaks may be far
shorter than the spacing of saved times: `resolved_loads` adds times until every visible peak is
resolved.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..checks.errors import SettingError, has_values
from ..checks.numbers import array_module, as_floats, as_jax, as_numpy
from ..checks.shapes import Numbers
from ..math.compiler import in_blocks, kept_jit
from ..math.derivative import safe_norm
from ..mechanics.size import mechanism_size
from ..mechanics.state import State
from ..mechanics.system import System
from .evaluation import Saved, evaluate_reactions
from .formulations.base import AbstractFormulation, Reactions, in_joint_axes
from .formulations.stabilisation import Unstabilised
from .integration.problem import at_internal
from .simulation import Run, interpolate_states
from .tree.formulation import Tree

# Load components that size a joint; the last axis of `JointLoads.components`, with units.
COMPONENTS = ("F_x", "F_y", "F_z", "|F|", "M_x", "M_y", "M_z", "|M|")
UNITS = ("N",) * 4 + ("N m",) * 4

_BLOCK = 64  # number of times in one call, so that all calls share one compilation
_ROUNDS = 12  # largest number of halvings of the spacing of saved times


class JointLoads(eqx.Module):
    """Reaction loads at every joint over time, with optional leading axes (runs).

    Attributes:
        ts: times (*b, k) [s].
        force: force on body j, axes of the joint's frame on body i (*b, k, joints, 3) [N].
        moment: moment about the joint's point on body j, same axes (*b, k, joints, 3) [N m].
        joints: names of the joints.
    """

    ts: Float[Array | np.ndarray, "*b k"]
    force: Float[Array | np.ndarray, "*b k joints 3"]
    moment: Float[Array | np.ndarray, "*b k joints 3"]
    joints: tuple[str, ...] = eqx.field(static=True)

    @property
    def components(self) -> Float[Array | np.ndarray, "*b k joints 8"]:
        """Force and its magnitude [N], moment and its magnitude [N m]: see `COMPONENTS`."""
        xp = array_module(self.force, self.moment)
        size = safe_norm if xp is jnp else np.linalg.norm
        parts = []
        for vector in as_numpy((self.force, self.moment)):
            parts += [vector, size(vector, axis=-1)[..., None]]
        return xp.concatenate(parts, axis=-1)


class Envelope(eqx.Module):
    """Minimum and maximum of each load component at every joint, and where they occur.

    Attributes:
        minimum, maximum: minimum and maximum (joints, 8) [N], [N m], columns as in `COMPONENTS`.
        t_minimum, t_maximum: times of the extremes (joints, 8) [s].
        run_minimum, run_maximum: indices of their runs in a flattened batch (joints, 8).
        joints: names of the joints.
    """

    minimum: Float[Array, "joints 8"]
    maximum: Float[Array, "joints 8"]
    t_minimum: Float[Array, "joints 8"]
    t_maximum: Float[Array, "joints 8"]
    run_minimum: Int[Array, "joints 8"]
    run_maximum: Int[Array, "joints 8"]
    joints: tuple[str, ...] = eqx.field(static=True)


def joint_loads(
    system: System,
    ts: Float[Array, " k"],
    states: State,
    formulation: AbstractFormulation | None = None,
    internal: Float[Array, "k m"] | None = None,
) -> JointLoads:
    """Reaction loads of states (k, n, .) at times ts (k,) [s], such as those of `integrate`.

    The function is pure: it may be jitted, vmapped and differentiated. If rows of a loop depend on each
    other, the equations of motion do not determine all reactions; those given have multipliers of minimum
    norm, as those of `run_loads`, and a reaction that is determined is right. They are NaN at states that
    are, and with a formulation that allows for no dependent rows.

    Args:
        formulation: default `Tree(redundant=True)`.
        internal: actuator states of the forces (k, m), if any; by default those that they hold.
    """
    chosen_formulation = formulation if formulation is not None else Tree(redundant=True)
    model: Any = chosen_formulation.prepare(system)

    def reactions_at(t: Float[Array, ""], state: State, z: Float[Array, " m"] | None) -> Reactions:
        now = model if z is None else at_internal(model, z)
        result = chosen_formulation.accelerations(now, t, state, Unstabilised())
        return in_joint_axes(system, state, chosen_formulation.reactions(now, t, state, result))

    joint_reactions = jax.vmap(reactions_at)(ts, states, internal)
    return JointLoads(
        ts, joint_reactions.force, joint_reactions.moment, tuple(j.name for j in system.joints)
    )


def run_loads(run: Run) -> JointLoads:
    """Reaction loads at the saved times of a run, from its analysis."""
    system = run.scene.system
    joint_reactions = _in_joint_axes(system, run.states, run.snapshot.reactions)
    force, moment = as_floats(joint_reactions.force), as_floats(joint_reactions.moment)
    return JointLoads(as_floats(run.ts), force, moment, tuple(j.name for j in system.joints))


def _in_joint_axes(system: System, states: State, world: Reactions) -> Reactions:
    """Reactions at many states (k, joints, 3) in the joints' axes, as NumPy arrays."""
    rotate_block = lambda *at: _rotate_reactions(system, *jax.tree.map(as_jax, at))
    return in_blocks(rotate_block, _BLOCK, states, world)


@kept_jit
def _rotate_reactions(system: System, states: State, world: Reactions) -> Reactions:
    return jax.vmap(lambda state, world_reactions: in_joint_axes(system, state, world_reactions))(
        states, world
    )


def resolved_loads(run: Run, rtol: float = 0.01) -> JointLoads:
    """Reaction loads of a run at its saved times and at further times that resolve the peaks.

    Every interval is quartered, and halved further until the load at its middle is within rtol of
    the joint's largest force and moment from the straight line between its ends. A peak shorter
    than a quarter of the spacing of saved times, invisible at these times, is missed.

    Raises:
        SettingError: rtol is not positive.
    """
    if not rtol > 0:
        raise SettingError(f"The loads' rtol must be positive, but it is {rtol}.")
    first = run_loads(run)
    ts = np.asarray(run.ts)
    values = np.concatenate([np.asarray(first.force), np.asarray(first.moment)], axis=-1)
    system = run.scene.system
    arms = np.array([1.0, float(mechanism_size(system, system.reference))])
    todo = np.stack([ts[:-1], ts[1:]], axis=1)[: len(ts) * len(first.joints)]
    for turn in range(_ROUNDS):
        if not len(todo):
            break
        # An interval whose middle lies on the chord has no peak that linear interpolation would miss.
        middle = todo.mean(axis=1)
        fresh = _loads_at(run, middle)
        ends = values[np.searchsorted(ts, todo)]
        order = np.argsort(np.concatenate([ts, middle]), kind="stable")
        ts = np.concatenate([ts, middle])[order]
        values = np.concatenate([values, fresh])[order]
        deviations = np.abs(fresh - ends.mean(axis=1)).reshape(*fresh.shape[:2], 2, 3)
        peak = np.linalg.norm(values.reshape(-1, *deviations.shape[1:]), axis=-1).max(axis=0)
        # A load that is mere round-off beside the largest force, or its moment over the mechanism's size, needs
        # no further times.
        largest = (peak / arms).max(initial=1e-300)
        scale = np.maximum(peak, 1e-9 * largest * arms)[:, :, None]
        # The first two rounds halve every interval: a load may cross the chord in the middle and depart from
        # it elsewhere.
        curved = np.any(deviations > rtol * scale, axis=(1, 2, 3)) | (turn < 2)
        halves = np.stack([todo[:, 0], middle, middle, todo[:, 1]], axis=1)
        todo = halves[curved].reshape(-1, 2)
    return JointLoads(
        as_floats(ts), as_floats(values[..., :3]), as_floats(values[..., 3:]), first.joints
    )


def _loads_at(run: Run, ts: np.ndarray) -> np.ndarray:
    """Force and moment at all joints, at any times of a run (k, joints, 6)."""

    def evaluate_block(ts: np.ndarray) -> np.ndarray:
        states, internal = interpolate_states(run, ts)
        # by the programs of the run's analysis, which are compiled already
        world = evaluate_reactions(run.method.formulation, run.model, Saved(ts, states, internal))
        loads = _in_joint_axes(run.scene.system, states, world)
        return np.concatenate([loads.force, loads.moment], axis=-1)

    return in_blocks(evaluate_block, _BLOCK, ts)


def envelope(loads: JointLoads) -> Envelope:
    """Extreme load components over all times and runs, with their times and runs.

    The derivative of an extreme is that of the load at its time and run.
    """
    xp = array_module(loads)
    loads = as_numpy(loads)
    values = loads.components
    count, joints = loads.ts.shape[-1], len(loads.joints)
    rows = values.reshape(loads.ts.size, joints, len(COMPONENTS))
    times = loads.ts.reshape(-1)

    def extreme_at(index: Any) -> list[Array]:
        value = xp.take_along_axis(rows, index[None], axis=0)[0]
        return [as_jax(x) for x in (value, times[index], index // count)]

    least, t_least, run_least = extreme_at(xp.argmin(rows, axis=0))
    most, t_most, run_most = extreme_at(xp.argmax(rows, axis=0))
    return Envelope(least, most, t_least, t_most, run_least, run_most, loads.joints)


def smooth_peaks(loads: JointLoads, order: Numbers = 64.0) -> Float[Array, "*b joints 2"]:
    """Peaks over time of |F| [N] and |M| [N m] as norms of order p: (sum_k |F_k|^p)^(1/p).

    The norm is smooth even where the true peak jumps from one time to another. For k times it lies
    between the peak and k^(1/p) times the peak.

    Raises:
        SettingError: the order is below 1.
    """
    if has_values(order) and not np.all(np.asarray(order) >= 1):
        raise SettingError(f"The order of a smooth peak must be at least 1, but it is {order}.")
    p = jnp.asarray(order, dtype=float)
    sizes = jnp.stack([safe_norm(part, axis=-1) for part in (loads.force, loads.moment)], axis=-1)
    # Divided by the largest, no power overflows; the result does not depend on the divisor, and its
    # derivative is left out.
    top = jax.lax.stop_gradient(jnp.max(sizes, axis=-3, keepdims=True))
    scale = jnp.where(top > 0, top, 1.0)
    total = jnp.sum((sizes / scale) ** p, axis=-3)
    some = total > 0
    norm = jnp.where(some, total, 1.0) ** (1.0 / p)
    # A maximum has derivatives at one time only and jumps between peaks; the norm is smooth.
    return jnp.where(some, scale[..., 0, :, :] * norm, 0.0)
