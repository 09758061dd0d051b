"""Way from a start to given joint coordinates, along which closed loops keep their branch.

Most loops close in more than one way: a four-bar's coupler lies on either side of a line. Coordinates
that are led from the start in small parts, with the loops closed after each, say which is meant.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...algebra.compiler import kept_jit
from ...algebra.derivative import held_constant
from ...mechanics.joint import Joint
from ...mechanics.joint_states import coordinates_of, relative
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.augmented import Augmented, displace
from .initial import nearest_step
from .joint_drivers import with_drivers

# A part of the way is at most `_LONGEST` [rad], [m], and there are at least `_FEWEST`. After each the
# loops are closed by `_STEPS_EACH` steps, whose last finds them open by less than `_CLOSED` [m], [rad];
# a start that need not be closed has `_STEPS_FIRST` more.
_LONGEST, _FEWEST, _STEPS_EACH, _STEPS_FIRST, _CLOSED = 0.1, 8, 4, 16, 1e-3


@kept_jit
def followed(
    system: System, start: State, q: dict[str, Array], t: Float[Array, ""]
) -> tuple[State, Bool[Array, ""]]:
    """State with given joint coordinates on the start's branch, and true if the whole way closed.

    Angles go the shorter way round. The steps are the smallest in the mass metric. The state is closed to
    some 1e-8 and has no derivatives.
    """
    system, start, q, t = held_constant((system, start, q, t))
    kin = system.kinematics(start)
    joints = {name: system.joints[system.joint_index(name)] for name in q}
    first = {name: relative(kin, joint)[0] for name, joint in joints.items()}
    way = {name: _shorter(joints[name], q[name] - first[name]) for name in q}
    longest = jnp.max(jnp.abs(jnp.concatenate(list(way.values()))), initial=0.0)
    parts = jnp.where(longest > 0, jnp.maximum(jnp.ceil(longest / _LONGEST), _FEWEST), 0.0)
    free = jnp.ones(6 * system.n_bodies, dtype=bool)
    zero = jax.tree.map(jnp.zeros_like, q)

    def again(carry: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
        state, fine, k = carry
        share = jnp.maximum(jnp.floor_divide(k, _STEPS_EACH), 0.0) / jnp.maximum(parts, 1.0)
        now = {name: first[name] + share * way[name] for name in q}
        model = Augmented().prepare(with_drivers(system, now, zero, t))
        eq = model.constraints.equations(t, system.kinematics(state))
        step = nearest_step(model, eq, free)(-eq.value).reshape(-1, 6)
        last = (k >= 0) & (jnp.mod(k, _STEPS_EACH) == _STEPS_EACH - 1)
        open_by = jnp.max(jnp.abs(model.constraints.scales() * eq.value), initial=0.0)
        r, p = displace(state.r, state.p, step)
        return State(r, p, state.v, state.omega), fine & (~last | (open_by <= _CLOSED)), k + 1

    # a way that does not close is not gone on
    more = lambda carry: carry[1] & (carry[2] < _STEPS_EACH * (parts + 1))
    possible, before = jnp.isfinite(longest), -_STEPS_FIRST + 0.0 * parts
    state, fine, _ = jax.lax.while_loop(more, again, (start, possible, before))
    return state, fine


def _shorter(joint: Joint, way: Float[Array, " c"]) -> Float[Array, " c"]:
    """Way of a joint's coordinates without whole turns, which a screw's displacement does tell."""
    if joint.pitched or joint.kind == "spherical":
        return way
    turns = np.array([unit == "rad" for _, unit in coordinates_of(joint.kind)])
    return jnp.where(turns, way - 2 * jnp.pi * jnp.round(way / (2 * jnp.pi)), way)
