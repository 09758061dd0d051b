"""Survey of any mechanism over two of its coordinates: reach, singular postures, and inputs that hold it.

Directions of motion are compared on the scale of `stmuav_jax.dynamics.actuation`: unit motions of all
bodies, inputs in weights. A direct singularity (type 2) is where `hold` is zero, an inverse one (type 1)
where `mobility` is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import SettingError, named_places
from ..checks.numbers import check_numbers
from ..checks.shapes import Numbers
from ..dynamics.actuation import Actuation, compute_actuation
from ..dynamics.formulations.independence import DEPENDENT
from ..dynamics.statespace.selection import velocity_names
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..math.compiler import kept_jit
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.joint_states import joint_motion
from ..mechanics.state import State
from ..mechanics.system import System


class Survey(NamedTuple):
    """Postures of a mechanism over a grid of two coordinates; NaN where its loops do not close.

    Attributes:
        coordinates: name and unit of the two coordinates.
        first, second: their values (k,), (l,) [rad] or [m].
        reachable: true where the loops close from the start along a straight line (k, l).
        conditioning: how well the coordinates determine the others (k, l), see `AbstractStateSpace`.
        values: inputs that hold the posture at rest, of minimum norm in weights (k, l, m).
        unbalanced: largest generalised force, in weights, that the inputs leave (k, l).
        hold: smallest singular value of the inputs' effect on unit motions (k, l): inputs of 1 / hold
            weights push with one weight along the weakest motion.
        mobility: smallest singular value of the velocities of `body` in unit motions (k, l).
        inputs: inputs. body: name of the body.
        weight: weight [N]. size: size of the mechanism at the start [m].
    """

    coordinates: tuple[tuple[str, str], tuple[str, str]]
    first: Float[np.ndarray, " k"]
    second: Float[np.ndarray, " l"]
    reachable: Bool[np.ndarray, "k l"]
    conditioning: Float[np.ndarray, "k l"]
    values: Float[np.ndarray, "k l m"]
    unbalanced: Float[np.ndarray, "k l"]
    hold: Float[np.ndarray, "k l"]
    mobility: Float[np.ndarray, "k l"]
    inputs: Inputs
    body: str
    weight: float
    size: float


@kept_jit
def _evaluate_postures(
    space: TreeSpace, x: TreePoint, steps: Float[Array, "k size"], inputs: Inputs, t: Array
) -> tuple[Actuation, Float[Array, " k"]]:
    """Actuation with inputs of zero, and conditioning, at the points retract(x, step)."""

    def evaluate_posture(step: Float[Array, " size"]) -> tuple[Actuation, Float[Array, ""]]:
        y = space.with_closed_loops(space.retract(x, step), t)
        none = jnp.zeros(len(inputs))
        return compute_actuation(space, y, inputs, none, t), space.conditioning(y, t)

    return jax.vmap(evaluate_posture)(steps)


def survey(
    system: System,
    coordinates: Sequence[str],
    ranges: Sequence[Numbers],
    *,
    inputs: Inputs | None = None,
    state: State | None = None,
    body: str | None = None,
    samples: int = 21,
    t: float = 0.0,
) -> Survey:
    """Survey of a mechanism at rest over a grid of two coordinates; the others stay as at the start.

    All postures are one compiled program, which serves other numbers of the same structure too.

    Args:
        system: mechanism, also with forces.
        coordinates: names of two coordinates of joints, such as "A.angle" or "slide.displacement", that
            are independent at the start.
        ranges: for each coordinate its first and last value, or three and more values [rad] or [m].
        inputs: inputs of the actuators, see `inputs_of`; by default all of the system.
        state: start; by default the reference posture. Its velocities do not count.
        body: name of the body whose directions of motion `mobility` is about, such as a platform; by
            default the first one of those with most freedom.
        samples: number of values between two limits.
        t: time [s], where forces or joints depend on it.

    Raises:
        SettingError: other than two names or ranges, names that are unknown, or a body that is.
        ModelError: numbers that are not finite, a singular start, or coordinates that depend on each other.
    """
    if isinstance(coordinates, str) or len(coordinates) != 2 or len(ranges) != 2:
        raise SettingError("A survey needs the names of two coordinates, and a range for each.")
    state = system.reference if state is None else state
    # Velocities of the start would add Coriolis and centrifugal loads to what holds the postures.
    rest = jnp.zeros_like(state.v)
    state = State(state.r, state.p, rest, rest)
    space = TreeSpace(system, state, independent=list(coordinates), t=t)
    names = [name for name, _ in space.names[: space.dof]]
    places = named_places(list(coordinates), names, "The coordinates of a survey", "coordinate")
    if body is not None and body not in system.names:
        raise SettingError(f"There is no body '{body}'. Bodies: {', '.join(system.names)}.")
    inputs = inputs_of(system) if inputs is None else inputs
    axes, starts = [], []
    for limits, name in zip(ranges, coordinates, strict=True):
        axis = np.asarray(check_numbers(limits, np.shape(limits), f"The range of {name}", ""))
        if axis.ndim != 1 or len(axis) < 2 or samples < 2:
            raise SettingError(
                f"The range of {name} must be two limits or a list of values, with at least 2 samples, not "
                f"{axis.tolist()} and {samples} samples."
            )
        axes.append(np.linspace(axis[0], axis[1], samples) if len(axis) == 2 else axis)
        starts.append(_read_start(space, state, name))
    first, second = np.meshgrid(*axes, indexing="ij")
    steps = np.zeros((first.size, space.size))
    for place, values, start in zip(places, (first, second), starts, strict=True):
        # Each posture is one retraction from the start, so that all are independent and run as one batch.
        steps[:, place] = values.ravel() - start
    point = space.from_state(state)
    postures, conditioning = jax.tree.map(
        np.asarray,
        _evaluate_postures(space, point, jnp.asarray(steps), inputs, jnp.asarray(t, float)),
    )
    reachable = np.isfinite(postures.load).all(axis=1)
    reachable &= np.isfinite(postures.forces).all(axis=(1, 2))
    T, load = postures.forces[reachable], postures.load[reachable]
    # Inputs of least norm that hold the weight; what they cannot hold remains as the rest.
    shares = -np.einsum("kmd,kd->km", np.linalg.pinv(T, rcond=DEPENDENT**2), load)
    rest_load = load + np.einsum("kdm,km->kd", T, shares)
    # Rotations times the mechanism's size are lengths, comparable with displacements.
    metric = np.where(np.arange(6) < 3, 1.0, postures.size[reachable][:, None])[..., None]
    motions = postures.motions[reachable]
    velocities = {
        name: motions[:, 6 * k : 6 * k + 6] * metric for k, name in enumerate(system.names)
    }
    if body is None:
        rank = lambda name: int(
            np.max(np.linalg.matrix_rank(velocities[name], tol=DEPENDENT), initial=0)
        )
        # Most degrees of freedom: the end effector of a robot, or the platform.
        body = max(system.names, key=rank)

    def spread(values: np.ndarray) -> np.ndarray:
        """Values of the postures that are reachable on the grid, NaN elsewhere."""
        result = np.full((len(reachable), *values.shape[1:]), np.nan)
        result[reachable] = values
        return result.reshape(*first.shape, *values.shape[1:])

    return Survey(
        (space.names[places[0]], space.names[places[1]]), axes[0], axes[1], reachable.reshape(first.shape),
        conditioning.reshape(first.shape), spread(shares * postures.scales[reachable]),
        spread(np.max(np.abs(rest_load), axis=1, initial=0.0)), spread(_smallest_values(T)),
        spread(_smallest_values(velocities[body])), inputs, body, float(postures.weight[0]),
        float(postures.size[0]),
    )  # fmt: skip


def _read_start(space: TreeSpace, state: State, name: str) -> float:
    """Value of a coordinate of the space [rad], [m] at the start of a survey."""
    tree, joint = space.model.parameters.tree, name.rpartition(".")[0]
    if joint not in tree.joints:
        raise SettingError(
            f"A survey is over coordinates of joints, such as hinge.angle, and '{name}' is not one."
        )
    number = tree.joints.index(joint)
    if space.system.joints[number].kind == "spherical":
        raise SettingError(
            f"A survey is over angles and displacements of joints, and '{name}' is a part of a rotation vector."
        )
    of_joint = [label for label, _ in velocity_names(tree) if label.startswith(f"{joint}.")]
    # the tree may pass a joint from body j to body i, which meets its motions in the opposite order
    forward = next(link.forward for link in tree.links if link.joint == number)
    place = (of_joint if forward else of_joint[::-1]).index(name)
    return float(joint_motion(space.system, state, joint).coordinates[place])


def _smallest_values(matrices: np.ndarray) -> np.ndarray:
    """Singular value of each matrix (k, ., .) in the place of the largest rank among all."""
    if not matrices.size:
        return np.zeros(len(matrices))
    values = np.linalg.svd(matrices, compute_uv=False)
    # A body with fewer freedoms than six has singular values of zero everywhere; the smallest one
    # that says something is at the largest rank of all postures.
    rank = np.sum(values > DEPENDENT * np.max(values, initial=0.0), axis=1)
    return values[:, max(int(np.max(rank)), 1) - 1]
