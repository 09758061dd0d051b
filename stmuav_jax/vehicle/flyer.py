"""The UAV with its tracker in independent coordinates: 8 degrees of freedom, 8 inputs.

Positions are the base's r_w [m] and attitude (Euler parameters), and the panel angles
(phi, theta) [rad]; velocities the base's v_w [m/s] and omega (its axes) [rad/s], and the
angles' rates. Inputs are the squared speeds of the rotors [rad^2/s^2] and the forces of
the two actuators [N]. Loops are closed by the tracker's closed form, so nothing has to be
projected and all of it can be differentiated.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import (
    conjugate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ..dynamics.coordinates import join, split
from ..dynamics.stabilisation import Unstabilised
from ..dynamics.tree import Tree, TreeModel
from ..mechanics.errors import ModelError
from ..mechanics.sampled import Sampled
from ..mechanics.state import State
from ..mechanics.system import System
from .actuator import LinearActuator
from .drive import SLIDER_JOINTS
from .geometry import TrackerGeometry
from .kinematics import angle_motion, panel_angles, stroke_jacobian
from .motor import MotorRotors
from .placement import posture
from .rotor import Rotors
from .workspace import Limits

# Euler parameters of the world's axes.
_LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


class Coordinates(NamedTuple):
    """Independent coordinates and velocities.

    Attributes:
        r: of the base, world (3,) [m]. p: its Euler parameters (4,).
        angles: (phi, theta) (2,) [rad].
        v: of the base, world (3,) [m/s]. omega: in its axes (3,) [rad/s].
        rates: of the angles (2,) [rad/s].
    """

    r: Float[Array, "3"]
    p: Float[Array, "4"]
    angles: Float[Array, "2"]
    v: Float[Array, "3"]
    omega: Float[Array, "3"]
    rates: Float[Array, "2"]


class Inputs(NamedTuple):
    """squared: of the rotors' speeds (k,) [rad^2/s^2]. forces: of the actuators (2,) [N].

    As functions of (t, kinematics), such as `Sampled`, they are histories.
    """

    squared: Any
    forces: Any


class Accelerations(NamedTuple):
    """Of the independent coordinates: v world (3,), omega base axes (3,), angles (2,)."""

    v: Float[Array, "3"]
    omega: Float[Array, "3"]
    angles: Float[Array, "2"]


class _Part(eqx.Module):
    """One component of a history."""

    whole: Any
    place: int = eqx.field(static=True)

    def __call__(self, t: Any, kin: Any) -> Array:
        return self.whole(t, kin)[self.place]


class Flyer(eqx.Module):
    """A system of base and tracker, with rotors and actuators, prepared for coordinates.

    Args:
        system: the seven bodies, base first, with one `Rotors` or `MotorRotors` and forces in the
            sliders: one `LinearActuator` each. Other forces stay as they are.
        geometry: of its tracker. shift: of the tracker in the base's frame (3,) [m].
        limits: what bounds the tracker's workspace (`tracker_limits`), to which `trim` keeps;
            None for what its rods reach.

    Raises:
        ModelError: no rotors, or not two actuators.
    """

    system: System
    geometry: TrackerGeometry
    shift: Float[Array, "3"]
    limits: Limits | None
    rotors: int = eqx.field(static=True)
    actuators: tuple[int, int] = eqx.field(static=True)

    def __init__(
        self, system: System, geometry: TrackerGeometry, shift: Any, limits: Limits | None = None
    ) -> None:
        rotors = [k for k, f in enumerate(system.forces) if isinstance(f, Rotors | MotorRotors)]
        pushers = {
            f.slider: k for k, f in enumerate(system.forces) if isinstance(f, LinearActuator)
        }
        if len(rotors) != 1 or set(pushers) != {"slider_2", "slider_3"}:
            raise ModelError(
                "A flyer needs one set of rotors and one LinearActuator for each slider, but the "
                f"system has {len(rotors)} and those for {', '.join(sorted(pushers)) or 'none'}."
            )
        self.system, self.geometry = system, geometry
        self.shift, self.limits = jnp.asarray(shift, dtype=float), limits
        self.rotors = rotors[0]
        self.actuators = (pushers["slider_2"], pushers["slider_3"])

    @property
    def propulsion(self) -> Rotors | MotorRotors:
        """The force element of the rotors, with their motors if they have any."""
        return self.system.forces[self.rotors]  # pyright: ignore[reportReturnType]

    @property
    def propellers(self) -> Rotors:
        """The rotors themselves."""
        own = self.propulsion
        return own.rotors if isinstance(own, MotorRotors) else own

    @property
    def lagging(self) -> bool:
        """Whether the rotors' speeds are states of their own: motors with a time constant."""
        own = self.propulsion
        return isinstance(own, MotorRotors) and own.time_constant is not None

    def steady(self) -> "Flyer":
        """The same with motors at steady speeds, see `MotorRotors.steady`."""
        own = self.propulsion
        if isinstance(own, Rotors):
            return self
        forces = list(self.system.forces)
        forces[self.rotors] = own.steady()
        system = eqx.tree_at(lambda s: s.forces, self.system, tuple(forces))
        return Flyer(system, self.geometry, self.shift, self.limits)

    def with_inputs(self, inputs: Inputs, speeds: Float[Array, " k"] | None = None) -> System:
        """The system with its rotors and actuators set, to numbers or to histories.

        Args:
            speeds: of rotors that lag, at the start [rad/s]; by default what is commanded where
                that is a number or a `Sampled` history, and else what they have.
        """
        forces = inputs.forces
        each = [_Part(forces, k) if callable(forces) else forces[k] for k in range(2)]
        where = lambda s: (
            self._commands(s),
            s.forces[self.actuators[0]].force,
            s.forces[self.actuators[1]].force,
        )
        system = eqx.tree_at(where, self.system, (inputs.squared, *each))
        if not self.lagging:
            return system
        if speeds is None:
            first = inputs.squared
            first = first(first.breaks[0]) if isinstance(first, Sampled) else first
            if callable(first):
                return system
            own: Any = self.propulsion
            speeds = own.speeds_of(jnp.asarray(first, dtype=float))
        return eqx.tree_at(lambda s: s.forces[self.rotors].internal, system, speeds)

    def _commands(self, system: Any) -> Any:
        own = system.forces[self.rotors]
        return own.rotors.speed_squared if isinstance(own, MotorRotors) else own.speed_squared

    def state(self, at: Coordinates) -> State:
        """Positions and velocities of all bodies (7, .)."""
        return whole_state(self.geometry, self.shift, at)

    def coordinates(self, state: State) -> Coordinates:
        """The independent coordinates of a state of all bodies (7, .) with closed loops."""
        panel = self.system.index("panel_7")
        R_wb, R_wp = rotation_matrix(state.p[0]), rotation_matrix(state.p[panel])
        n = R_wb.T @ R_wp[:, 2]
        turning = R_wb.T @ (R_wp @ state.omega[panel]) - state.omega[0]
        angles, rates = jax.jvp(panel_angles, (n,), (jnp.cross(turning, n),))
        return Coordinates(state.r[0], state.p[0], angles, state.v[0], state.omega[0], rates)

    def model(self) -> TreeModel:
        """The tree's numbers, which do not depend on the inputs; for `accelerations`."""
        return Tree().prepare(self.system)

    def accelerations(
        self,
        at: Coordinates,
        inputs: Inputs,
        t: Float[Array, ""] | float = 0.0,
        model: TreeModel | None = None,
        speeds: Float[Array, " k"] | None = None,
    ) -> Accelerations:
        """Of the independent coordinates, from the tree's equations.

        Args:
            model: what `model` gives, if it is there already.
            speeds: of rotors that lag [rad/s]; default as commanded.
        """
        model = self.model() if model is None else model
        model = replace(model, system=self.with_inputs(inputs, speeds))
        tree, spanned = Tree(), model.chain.tree
        # the joints' coordinates are the same wherever the base is and however it moves
        still = at._replace(p=jnp.asarray(_LEVEL), v=jnp.zeros(3), omega=jnp.zeros(3))
        inside = split(spanned, tree.to_vector(model, self.state(still)))
        column = lambda x: x[:, None]
        x = join(inside._replace(p=column(at.p), v=column(at.v), omega=column(at.omega)))
        rate, _ = tree.derivative(model, jnp.asarray(t, x.dtype), x, Unstabilised())
        found = split(spanned, rate)
        joints = [self.system.joint_index(name) for name in SLIDER_JOINTS]
        place = {s.joint: k for k, s in enumerate(spanned.steps)}
        slides = jnp.stack([found.u[place[j]] for j in joints])
        J = stroke_jacobian(self.geometry, at.angles)
        moving = angle_motion(self.geometry, at.angles, J @ at.rates, slides)
        return Accelerations(found.v[:, 0], found.omega[:, 0], moving.acceleration)


def whole_state(geometry: TrackerGeometry, shift: Float[Array, "3"], at: Coordinates) -> State:
    """Positions and velocities of base and tracker (7, .), base first.

    Args:
        shift: of the tracker in the base's frame [m].
    """
    inside = posture(geometry, at.angles, at.rates)
    R = rotation_matrix(at.p)
    arms = inside.r + shift
    turning = jax.vmap(rotation_matrix)(inside.p)
    r = at.r + arms @ R.T
    v = at.v + (inside.v + jnp.cross(at.omega, arms)) @ R.T
    p = jax.vmap(product, in_axes=(None, 0))(at.p, inside.p)
    omega = inside.omega + jnp.einsum("nji,j->ni", turning, at.omega)
    first = lambda x, y: jnp.concatenate([x[None], y])
    return State(first(at.r, r), first(at.p, p), first(at.v, v), first(at.omega, omega))


def shifted(at: Coordinates, x: Float[Array, "16"]) -> Coordinates:
    """The point displaced by x = (dr, dtheta, d angles, dv, domega, d rates)."""
    return Coordinates(
        at.r + x[:3],
        product(at.p, from_rotation_vector(x[3:6])),
        at.angles + x[6:8],
        at.v + x[8:11],
        at.omega + x[11:14],
        at.rates + x[14:16],
    )


def displacement(to: Coordinates, at: Coordinates) -> Float[Array, "16"]:
    """The x with `shifted(at, x)` at `to`; the turn is the shorter of the two."""
    turned = product(conjugate(at.p), to.p)
    turned = jnp.where(turned[0] < 0, -turned, turned)
    return jnp.concatenate(
        [
            to.r - at.r,
            to_rotation_vector(turned),
            to.angles - at.angles,
            to.v - at.v,
            to.omega - at.omega,
            to.rates - at.rates,
        ]
    )
