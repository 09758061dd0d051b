"""Motion of the other bodies of a flying machine relative to its base, for estimators, from encoders.

A machine's tracker is moved by two panel angles and seen by the strokes of its sliders; an open chain of
joints is moved by their coordinates, which encoders read.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..dynamics.tree.topology import spanning_tree
from ..math.compiler import quick_jit
from ..math.rotation import conjugate, product, rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System
from .panel_servo import PanelBodies, panel_motion
from .tracker.bodies import SLIDER_JOINTS, place_on_base
from .tracker.kinematics import stroke_jacobian, strokes


class BasePose(NamedTuple):
    """Motion of a base: position, Euler parameters, velocity, all in the world, and angular velocity, own axes."""

    r: Float[Array, "3"]
    p: Float[Array, "4"]
    v: Float[Array, "3"]
    omega: Float[Array, "3"]


class TrackerMotion(eqx.Module):
    """Motion of a tracker by its panel angles (2,) [rad], seen by the strokes of its sliders [m].

    Args:
        bodies: bodies of the tracker. reference: state at which encoders read zero.
    """

    names: ClassVar[tuple[str, ...]] = ("phi", "theta")
    encoders: ClassVar[tuple[str, ...]] = SLIDER_JOINTS
    bodies: PanelBodies
    home: Float[Array, "2"]

    def __init__(self, bodies: PanelBodies, reference: State) -> None:
        self.bodies, self.home = bodies, _read_strokes(bodies, reference)

    def read(self, state: State) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Coordinates and their rates at a state."""
        motion = panel_motion(state)
        return motion.value, motion.rate

    def innovation(self, readings: Float[Array, "2"], x: Float[Array, "2"]) -> Float[Array, "2"]:
        """Readings of the encoders less those at coordinates x."""
        return readings - (strokes(self.bodies.geometry, x) - self.home)

    def jacobian(self, x: Float[Array, "2"]) -> Float[Array, "2 2"]:
        """Derivatives of the readings by the coordinates."""
        return stroke_jacobian(self.bodies.geometry, x)

    def place(self, base: BasePose, x: Float[Array, "2"], rates: Float[Array, "2"]) -> State:
        """State of all bodies."""
        return place_on_base(self.bodies.geometry, self.bodies.shift, x, rates, *base)


@quick_jit
def _read_strokes(bodies: PanelBodies, state: State) -> Float[Array, "2"]:
    """Strokes (2,) [m] at a state."""
    return strokes(bodies.geometry, panel_motion(state).value)


class JointChain(eqx.Module):
    """Motion of an open chain by the angles [rad] and displacements [m] of its joints (n,), which encoders read.

    Its coordinates, and the joints that encoders read, have the `names` of the joints.

    Args:
        system: machine, whose first body is the base.

    Raises:
        SettingError: a joint that closes a loop, or whose motion is not one angle or displacement.
    """

    space: TreeSpace
    home: TreePoint
    names: tuple[str, ...] = eqx.field(static=True)
    encoders: tuple[str, ...] = eqx.field(static=True)
    turning: tuple[bool, ...] = eqx.field(static=True)

    def __init__(self, system: System) -> None:
        # The estimator keeps one coordinate for each encoder: loops would need them consistent,
        # and a ball joint has three that no encoder reads.
        tree = spanning_tree(system)
        single = {"revolute": True, "translational": False}
        wrong = [j.name for j in system.joints if j.kind not in single]
        wrong += [tree.joints[k] for k in tree.cut]
        if wrong or not tree.floating:
            raise SettingError(
                "The estimator needs a floating base with an open chain of revolute and translational joints, which "
                f"this machine is not: {', '.join(wrong) or 'its base is fixed'}. Leave the mission's [sensors] out, "
                "for true states."
            )
        self.space = TreeSpace(system)
        self.home = self.space.from_state(system.reference)
        names = [name for name, _ in self.space.names[6 : self.space.dof]]
        self.names = self.encoders = tuple(name.rpartition(".")[0] for name in names)
        self.turning = tuple(name.endswith(".angle") for name in names)

    def read(self, state: State) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Coordinates and their rates at a state."""
        x = self.space.from_state(state)
        return self.space.difference(x, self.home)[6 : self.space.dof], x.u

    def innovation(self, readings: Float[Array, " n"], x: Float[Array, " n"]) -> Float[Array, " n"]:
        """Readings of the encoders less those at coordinates x, angles by the nearer way round."""
        # An encoder of a hinge repeats after a turn, the estimate does not: the innovation is the
        # difference by the nearer way.
        return shorten_turns(readings - x, self.turning)

    def jacobian(self, x: Float[Array, " n"]) -> Float[Array, "n n"]:
        """Derivatives of the readings by the coordinates."""
        return jnp.eye(x.shape[0])

    def place(self, base: BasePose, x: Float[Array, " n"], rates: Float[Array, " n"]) -> State:
        """State of all bodies."""
        six = jnp.zeros(6)
        point = self.space.retract(self.home, jnp.concatenate([six, x, six, rates]))
        return set_on_base(self.space.to_state(point), base)


def shorten_turns(difference: Float[Array, " n"], turning: Sequence[bool]) -> Float[Array, " n"]:
    """Differences of coordinates (n,), those of angles by the nearer way round."""
    turns = 2 * jnp.pi * np.array(turning, dtype=float)
    return difference - turns * jnp.round(difference / (2 * jnp.pi))


def set_on_base(state: State, base: BasePose) -> State:
    """State in which the bodies move against the first one as before, and the first one as given."""
    # The chain is placed by its joints on a base at rest in the origin and then carried over: the
    # motion against the base does not depend on where that is or how it moves.
    R = rotation_matrix(state.p[0])
    turn, R_new = product(base.p, conjugate(state.p[0])), rotation_matrix(base.p)
    arms = (state.r - state.r[:1]) @ R
    omega_0 = jnp.broadcast_to(state.omega[0], arms.shape)
    # Velocities against the base, in its axes; the new base adds its own velocity and rotation to
    # them.
    v = (state.v - state.v[:1]) @ R - jnp.cross(omega_0, arms)
    R_b = jax.vmap(lambda p: R.T @ rotation_matrix(p))(state.p)
    into_body = lambda x: jnp.einsum("nji,j->ni", R_b, x)
    omega = state.omega - into_body(state.omega[0]) + into_body(base.omega)
    carried_v = v + jnp.cross(jnp.broadcast_to(base.omega, arms.shape), arms)
    p = jax.vmap(lambda p: product(turn, p))(state.p)
    return State(base.r[None] + arms @ R_new.T, p, base.v[None] + carried_v @ R_new.T, omega)
