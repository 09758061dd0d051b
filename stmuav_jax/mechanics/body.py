"""Rigid bodies: mass, centre of mass, inertia and reference pose, and bodies composed of simple shapes.

With masses m_k, centres c_k and tensors J_k about them, all in one frame, a compound has

    m = sum m_k,   c = sum m_k c_k / m,
    J = sum J_k + m_k (|c_k - c|^2 I - (c_k - c)(c_k - c)^T)      (parallel axes).

Source: any textbook of mechanics, e.g. Goldstein, Classical Mechanics (1980), ch. 5.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import ModelError, check_shape, has_values
from ..checks.numbers import (
    array_module,
    as_floats,
    as_numpy,
    check_inertia,
    check_mass,
    check_nonnegative,
    check_positive,
    check_unit,
    check_vector,
    stack_arrays,
)
from ..checks.shapes import Numbers, Quat, Scalar, Vec3
from ..math.native.structure import has_structure
from ..math.rotation import rotation_matrix, rotation_matrix_in

GROUND = "ground"


class Body(eqx.Module):
    """One rigid body, as the user describes it.

    Args:
        name: name by which joints and forces refer to the body.
        mass: mass [kg].
        inertia: inertia tensor about the centre of mass in body axes, (3, 3) or its
            diagonal (3,) [kg m^2]; off-diagonal entries are -int xy dm. A traced tensor is not
            checked, and its symmetric part counts: the derivative with respect to one of two
            opposite entries is then half of that with respect to both.
        com: centre of mass in the body's reference frame (3,) [m].
        position: origin of the body's reference frame in the world, at the reference
            posture (3,) [m]; with `com` zero it is the centre of mass.
        orientation: unit Euler parameters of the reference posture (4,).
        free: permission for the body and all bodies joined to it to float; without it a body that
            no chain of joints connects to ground is an error.
        triangle_tolerance: admitted relative excess of the largest principal moment over the sum
            of the other two, for printed, rounded tensors; zero by default.

    Raises:
        ModelError: the mass is not finite and positive; the tensor is not finite, symmetric or
            positive definite, or no mass distribution can have it; the Euler parameters are not
            unit. The message names the body.
    """

    name: str = eqx.field(static=True)
    mass: Scalar
    inertia: Float[Array, "3 3"]
    com: Vec3
    position: Vec3
    orientation: Quat
    free: bool = eqx.field(static=True)
    triangle_tolerance: float = eqx.field(static=True)

    def __init__(
        self,
        name: str,
        mass: Numbers,
        inertia: Numbers,
        *,
        com: Numbers = (0.0, 0.0, 0.0),
        position: Numbers = (0.0, 0.0, 0.0),
        orientation: Numbers = (1.0, 0.0, 0.0, 0.0),
        free: bool = False,
        triangle_tolerance: float = 0.0,
    ) -> None:
        if not name or name == GROUND:
            raise ModelError(f"A body cannot be named '{name}': '{GROUND}' is the fixed world.")
        self.name, self.free, self.triangle_tolerance = name, free, triangle_tolerance
        self.mass, tensor = as_floats(mass), as_floats(inertia)
        if tensor.shape == (3,):
            # Three numbers are principal moments.
            tensor = as_floats(array_module(tensor).diag(tensor))
        self.inertia = tensor
        if tensor.shape == (3, 3) and not has_values(tensor):
            # A derivative by one entry is then one of a symmetric tensor.
            self.inertia = 0.5 * (tensor + tensor.T)
        self.orientation = as_floats(orientation)
        check_shape(self.mass, (), f"The mass of body '{name}'")
        check_shape(self.inertia, (3, 3), f"The inertia tensor of body '{name}'")
        check_shape(self.orientation, (4,), f"The Euler parameters of body '{name}'")
        self.com = check_vector(com, f"The centre of mass of body '{name}'", "m")
        self.position = check_vector(position, f"The position of body '{name}'", "m")
        check_mass(self.mass, f"body '{name}'")
        check_inertia(self.inertia, f"body '{name}'", triangle_tolerance)
        check_unit(self.orientation, f"body '{name}'", ModelError)

    @property
    def com_position(self) -> Float[Array | np.ndarray, "3"]:
        """World position of the centre of mass at the reference posture (3,) [m]."""
        position, p, com = as_numpy((self.position, self.orientation, self.com))
        return position + rotation_matrix_in(array_module(p, position, com), p) @ com


@has_structure(zero=("com", "inertia"))
class Bodies(eqx.Module):
    """Moving bodies of a system, stacked: mass (n,), com (n, 3), inertia (n, 3, 3); names of those declared free."""

    names: tuple[str, ...] = eqx.field(static=True)
    mass: Float[Array, " n"]
    com: Float[Array, "n 3"]
    inertia: Float[Array, "n 3 3"]
    free: tuple[str, ...] = eqx.field(static=True, default=())


def stack_bodies(bodies: tuple[Body, ...]) -> Bodies:
    """Stack a user's bodies into arrays, in their order."""
    return Bodies(
        names=tuple(b.name for b in bodies),
        mass=stack_arrays([b.mass for b in bodies]),
        com=stack_arrays([b.com for b in bodies]),
        inertia=stack_arrays([b.inertia for b in bodies]),
        free=tuple(b.name for b in bodies if b.free),
    )


def check_bodies(bodies: Bodies) -> None:
    """Raise `ModelError` unless all masses and tensors of inertia are finite and positive.

    A body has them from its constructor, but numbers of a system may be replaced later. What a rounded
    table breaks of the triangle inequality is for the constructor to judge; traced numbers are not checked.
    """
    if not has_values(bodies.mass, bodies.inertia):
        return
    numbers = as_numpy((bodies.mass, bodies.inertia))
    for name, mass, inertia in zip(bodies.names, *numbers, strict=True):
        check_mass(mass, f"body '{name}'")
        check_inertia(inertia, f"body '{name}'", np.inf)


def has_positive_masses(bodies: Bodies) -> Bool[Array, ""]:
    """True if all masses, and the leading minors of all tensors of inertia, are finite and positive."""
    inertia = bodies.inertia
    a, b, c = inertia[:, 0, 0], inertia[:, 1, 1], inertia[:, 2, 2]
    d, e, f = inertia[:, 1, 2], inertia[:, 0, 2], inertia[:, 0, 1]
    # relative to the diagonal, whose powers may underflow
    d, e, f = d / jnp.sqrt(b * c), e / jnp.sqrt(a * c), f / jnp.sqrt(a * b)
    # Sylvester's criterion: closed form, and without the eigenvalues that a traced program would have to
    # find.
    minors = (a, b, c, 1 - f * f, 1 + 2 * d * e * f - d * d - e * e - f * f)
    least = jnp.stack([bodies.mass, *minors])
    return jnp.all((least > 0) & jnp.isfinite(least))


_ORIGIN = (0.0, 0.0, 0.0)
_LEVEL = (1.0, 0.0, 0.0, 0.0)


class Part(eqx.Module):
    """Mass distribution in the frame of the body of which it becomes a part.

    Parts are made by `point_mass`, `rod`, `cylinder`, `box`, `sphere`.

    Attributes:
        mass: mass [kg]. com: centre of mass (3,) [m].
        inertia: inertia tensor about it, in the frame's axes (3, 3) [kg m^2].
    """

    mass: Scalar
    com: Vec3
    inertia: Float[Array, "3 3"]


def compound(
    name: str,
    *parts: Part | Body,
    position: Numbers = _ORIGIN,
    orientation: Numbers = _LEVEL,
    free: bool = False,
) -> Body:
    """Rigid body made of parts that are fixed to each other.

    The body is differentiable with respect to all numbers of the parts.

    Args:
        parts: parts in the reference frame of the new body; a `Body` is placed there by its own
            position and orientation.
        position, orientation, free: arguments of the new `Body`. With the default pose the parts
            are given in the world, at the reference posture.

    Raises:
        ModelError: there are no parts, or the whole is no rigid body (a single thin rod).
    """
    if not parts:
        raise ModelError(f"Body '{name}' needs at least one part.")
    rigid_parts = [_of_body(part) if isinstance(part, Body) else part for part in parts]
    mass = jnp.sum(jnp.stack([part.mass for part in rigid_parts]))
    # Sums are traced like any numbers: a design may be differentiated by the mass or place of a
    # part.
    com = jnp.sum(jnp.stack([part.mass * part.com for part in rigid_parts]), axis=0) / mass
    # The parallel-axis theorem moves each part's tensor from its own centre to that of the body.
    tensors = [part.inertia + part.mass * _point_inertia(part.com - com) for part in rigid_parts]
    inertia = jnp.sum(jnp.stack(tensors), axis=0)
    return Body(name, mass, inertia, com=com, position=position, orientation=orientation, free=free)


def point_mass(mass: Numbers, at: Numbers = _ORIGIN) -> Part:
    """Point mass [kg] at a place (3,) [m]; alone it makes no rigid body.

    Raises:
        ModelError: the mass is not positive, or the place is not finite.
    """
    shape_name = "a point mass"
    m = check_positive(mass, f"The mass of {shape_name}", "kg")
    return Part(m, check_vector(at, f"The place of {shape_name}", "m"), jnp.zeros((3, 3)))


def rod(mass: Numbers, start: Numbers, end: Numbers) -> Part:
    """Uniform rod without thickness between two points (3,) [m], of mass [kg]: m l^2 / 12.

    Alone it makes no rigid body, as it has no inertia about its own axis; `cylinder` makes a rod
    with a thickness.

    Raises:
        ModelError: the mass is not positive, or both ends are the same point.
    """
    m = check_positive(mass, "The mass of a rod", "kg")
    middle, axis_vector, square = _span_points(start, end, "rod")
    return Part(m, middle, m / 12 * (square * jnp.eye(3) - axis_vector[:, None] * axis_vector))


def cylinder(
    start: Numbers,
    end: Numbers,
    radius: Numbers,
    *,
    inner_radius: Numbers = 0.0,
    mass: Numbers | None = None,
    density: Numbers | None = None,
) -> Part:
    """Uniform cylinder or tube with its axis between two points.

    m (r^2 + s^2) / 2 about the axis, m (3 (r^2 + s^2) + l^2) / 12 across it.

    Args:
        start, end: ends of the axis (3,) [m]. radius: r [m]. inner_radius: s of a tube [m].
        mass, density: one of the two [kg], [kg/m^3].

    Raises:
        ModelError: numbers are out of range; both mass and density are given, or neither.
    """
    middle, axis_vector, square = _span_points(start, end, "cylinder")
    r = check_positive(radius, "The radius of a cylinder", "m")
    s = check_nonnegative(inner_radius, "The inner radius of a cylinder", "m")
    if has_values(r, s) and not float(s) < float(r):
        raise ModelError(
            f"The inner radius of a cylinder must be less than its radius, but they are "
            f"{float(s):g} m and {float(r):g} m."
        )
    volume = jnp.pi * (r**2 - s**2) * jnp.sqrt(square)
    m = _solid_mass(mass, density, volume, "a cylinder")
    axis = axis_vector[:, None] * axis_vector / square
    round_, across = m * (r**2 + s**2) / 2, m * (3 * (r**2 + s**2) + square) / 12
    # The tensor of an axis needs no frame: a projection on the axis and one across it.
    return Part(m, middle, round_ * axis + across * (jnp.eye(3) - axis))


def box(
    sizes: Numbers,
    at: Numbers = _ORIGIN,
    orientation: Numbers = _LEVEL,
    *,
    mass: Numbers | None = None,
    density: Numbers | None = None,
) -> Part:
    """Uniform box: m (b^2 + c^2) / 12 about the axis of a, and so on.

    Args:
        sizes: edges a, b, c (3,) [m]. at: centre of the box (3,) [m].
        orientation: unit Euler parameters of its edges (4,).
        mass, density: one of the two [kg], [kg/m^3].

    Raises:
        ModelError: numbers are out of range; both mass and density are given, or neither.
    """
    # Signs are checked of the edges: two negative ones would have a positive volume.
    edges = check_vector(sizes, "The sizes of a box", "m")
    if has_values(edges) and not bool(jnp.all(edges > 0)):
        raise ModelError(f"The sizes of a box must be positive, but they are {edges.tolist()} m.")
    p = jnp.asarray(orientation, dtype=float)
    check_unit(p, "a box", ModelError)
    m = _solid_mass(mass, density, jnp.prod(edges), "a box")
    square = edges**2
    R = rotation_matrix(p)
    tensor = R @ jnp.diag(m / 12 * (jnp.sum(square) - square)) @ R.T
    return Part(m, check_vector(at, "The centre of a box", "m"), 0.5 * (tensor + tensor.T))


def sphere(
    radius: Numbers,
    at: Numbers = _ORIGIN,
    *,
    mass: Numbers | None = None,
    density: Numbers | None = None,
) -> Part:
    """Uniform ball: 2 m r^2 / 5.

    Args:
        radius: r [m]. at: centre of the ball (3,) [m].
        mass, density: one of the two [kg], [kg/m^3].

    Raises:
        ModelError: numbers are out of range; both mass and density are given, or neither.
    """
    r = check_positive(radius, "The radius of a sphere", "m")
    m = _solid_mass(mass, density, 4 / 3 * jnp.pi * r**3, "a sphere")
    return Part(m, check_vector(at, "The centre of a sphere", "m"), 0.4 * m * r**2 * jnp.eye(3))


def _solid_mass(
    mass: Numbers | None, density: Numbers | None, volume: Scalar, shape_name: str
) -> Scalar:
    if mass is not None and density is None:
        return check_positive(mass, f"The mass of {shape_name}", "kg")
    if density is not None and mass is None:
        return check_positive(density, f"The density of {shape_name}", "kg/m^3") * volume
    raise ModelError(f"{shape_name.capitalize()} needs either a mass or a density, and not both.")


def _span_points(start: Numbers, end: Numbers, shape_name: str) -> tuple[Vec3, Vec3, Scalar]:
    """Middle of two points, the vector from start to end, and its square."""
    a = check_vector(start, f"The start of a {shape_name}", "m")
    b = check_vector(end, f"The end of a {shape_name}", "m")
    axis_vector = b - a
    square = axis_vector @ axis_vector
    if has_values(square) and float(square) == 0:
        raise ModelError(
            f"The two ends of a {shape_name} must differ, but both are {a.tolist()} m."
        )
    return 0.5 * (a + b), axis_vector, square


def _point_inertia(arm: Vec3) -> Float[Array, "3 3"]:
    """Inertia factor |a|^2 I - a a^T of a point mass at the arm a."""
    return (arm @ arm) * jnp.eye(3) - arm[:, None] * arm


def _of_body(body: Body) -> Part:
    R = rotation_matrix(body.orientation)
    tensor = R @ body.inertia @ R.T
    return Part(body.mass, jnp.asarray(body.com_position), 0.5 * (tensor + tensor.T))
