"""Forces that a mission's reference of the panel asks of the tracker's actuators."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.derivative import motion_along
from ..checks.errors import SettingError
from ..control.geometric import attitude_of
from ..control.panel import PanelBodies, inverse_dynamics, panel_bodies
from ..sensing.sensors import gravity_of
from ..tracker.geometry import tracker_geometry
from ..tracker.kinematics import PairMotion, panel_angles
from .machine import Machine
from .reference import References
from .schema import MissionFile

# Times of a flight and of each move at which forces are checked.
_OF_FLIGHT, _OF_MOVE = 1001, 101


def check_forces(given: MissionFile, machine: Machine, references: References) -> None:
    """Raise `SettingError` for a reference of the panel that is beyond the actuators.

    The forces are those of the inverse dynamics of the machine with its payload. The base has the
    attitude and the acceleration that its path needs; that it turns is left out, as are friction,
    gusts and pushes, for which a margin must be left.
    """
    if machine.force is None or machine.table is None or references.panel is None:
        return
    ts = _times(given)
    system, shift = machine.scene.system, machine.table.value("mount.shift")
    bodies = panel_bodies(system, tracker_geometry(machine.table), shift)
    forces = np.asarray(needed_forces(bodies, references, gravity_of(system), jnp.asarray(ts)))
    beyond = np.abs(forces) > machine.force
    if not np.any(beyond):
        return
    k = int(np.argmax(np.any(beyond, axis=1)))
    slider = int(np.argmax(np.abs(forces[k])))
    most, late = np.max(np.abs(forces)), int(np.argmax(np.max(np.abs(forces), axis=1)))
    raise SettingError(
        f"The panel cannot follow its reference: at t = {ts[k]:.4g} s slider {slider + 2} needs a force of "
        f"{forces[k, slider]:.4g} N, but its actuator gives at most {machine.force:g} N either way "
        f"('controller.force'). The largest force is {most:.4g} N, at t = {ts[late]:.4g} s: give the move "
        "more time, or another goal."
    )


def _times(given: MissionFile) -> np.ndarray:
    """Times at which forces are checked (k,) [s]."""
    own = [np.linspace(move.at, move.at + move.duration, _OF_MOVE) for move in given.panel]
    ts = np.unique(np.concatenate([np.linspace(0.0, given.t1, _OF_FLIGHT), *own]))
    return ts[ts <= given.t1]


@quick_jit
def needed_forces(
    bodies: PanelBodies,
    references: References,
    gravity: Float[Array, "3"],
    ts: Float[Array, " k"],
) -> Float[Array, "k 2"]:
    """Forces of the actuators along references at times ts [s], by `inverse_dynamics` (k, 2) [N].

    Args:
        gravity: acceleration of free fall (3,) [m/s^2].
    """

    def posed(t: Array) -> tuple[Array, Array]:
        """Attitude of the base, and the acceleration of free fall less its own in its axes."""
        at = references.path(t)
        R = attitude_of(at.a - gravity, at.heading)
        return R, R.T @ (gravity - at.a)

    def angles(t: Array) -> Array:
        assert references.panel is not None
        value = references.panel.value(t)
        return panel_angles(posed(t)[0].T @ value) if references.panel.world else value

    def at_one(t: Array) -> Array:
        moved = PairMotion(*motion_along(angles, t))
        return inverse_dynamics(bodies, moved, posed(t)[1], jnp.zeros(3)).forces

    return jax.vmap(at_one)(ts)
