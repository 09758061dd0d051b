"""Rigid bodies composed of simple shapes: mass, centre of mass and inertia of the whole.

With masses m_k, centres c_k and tensors J_k about them, all in one frame,

    m = sum m_k,   c = sum m_k c_k / m,
    J = sum J_k + m_k (|c_k - c|^2 I - (c_k - c)(c_k - c)^T)      (parallel axes).

Source: any textbook of mechanics, e.g. Goldstein, Classical Mechanics (1980), ch. 5.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..checks.errors import ModelError, concrete
from ..checks.numbers import nonnegative, positive, vector
from ..checks.physical import check_unit
from ..checks.shapes import Numbers
from .body import Body

_ORIGIN = (0.0, 0.0, 0.0)
_LEVEL = (1.0, 0.0, 0.0, 0.0)


class Part(eqx.Module):
    """Mass distribution in the frame of the body of which it becomes a part.

    Parts are made by `point_mass`, `rod`, `cylinder`, `box`, `sphere`.

    Attributes:
        mass: mass [kg]. com: centre of mass (3,) [m].
        inertia: inertia tensor about it, in the frame's axes (3, 3) [kg m^2].
    """

    mass: Float[Array, ""]
    com: Float[Array, "3"]
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
        raise ModelError(f"Body '{name}' is made of no parts.")
    known = [_of_body(part) if isinstance(part, Body) else part for part in parts]
    mass = jnp.sum(jnp.stack([part.mass for part in known]))
    com = jnp.sum(jnp.stack([part.mass * part.com for part in known]), axis=0) / mass
    tensors = [part.inertia + part.mass * _about(part.com - com) for part in known]
    inertia = jnp.sum(jnp.stack(tensors), axis=0)
    return Body(name, mass, inertia, com=com, position=position, orientation=orientation, free=free)


def point_mass(mass: Numbers, at: Numbers = _ORIGIN) -> Part:
    """Point mass [kg] at a place (3,) [m]; alone it makes no rigid body.

    Raises:
        ModelError: the mass is not positive, or the place is not finite.
    """
    what = "a point mass"
    m = positive(mass, f"The mass of {what}", "kg")
    return Part(m, vector(at, f"The place of {what}", "m"), jnp.zeros((3, 3)))


def rod(mass: Numbers, start: Numbers, end: Numbers) -> Part:
    """Uniform rod without thickness between two points (3,) [m], of mass [kg]: m l^2 / 12.

    Alone it makes no rigid body, as it has no inertia about its own axis; `cylinder` makes a rod
    with a thickness.

    Raises:
        ModelError: the mass is not positive, or both ends are the same point.
    """
    m = positive(mass, "The mass of a rod", "kg")
    middle, along, square = _between(start, end, "rod")
    return Part(m, middle, m / 12 * (square * jnp.eye(3) - along[:, None] * along))


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
    middle, along, square = _between(start, end, "cylinder")
    r = positive(radius, "The radius of a cylinder", "m")
    s = nonnegative(inner_radius, "The inner radius of a cylinder", "m")
    if concrete(r, s) and not float(s) < float(r):
        raise ModelError(
            f"The inner radius of a cylinder must be less than its radius, but they are "
            f"{float(s):g} m and {float(r):g} m."
        )
    volume = jnp.pi * (r**2 - s**2) * jnp.sqrt(square)
    m = _mass(mass, density, volume, "a cylinder")
    axis = along[:, None] * along / square
    round_, across = m * (r**2 + s**2) / 2, m * (3 * (r**2 + s**2) + square) / 12
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
    edges = vector(sizes, "The sizes of a box", "m")
    if concrete(edges) and not bool(jnp.all(edges > 0)):
        raise ModelError(f"The sizes of a box must be positive, but they are {edges.tolist()} m.")
    p = jnp.asarray(orientation, dtype=float)
    check_unit(p, "a box", ModelError)
    m = _mass(mass, density, jnp.prod(edges), "a box")
    square = edges**2
    R = rotation_matrix(p)
    tensor = R @ jnp.diag(m / 12 * (jnp.sum(square) - square)) @ R.T
    return Part(m, vector(at, "The centre of a box", "m"), 0.5 * (tensor + tensor.T))


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
    r = positive(radius, "The radius of a sphere", "m")
    m = _mass(mass, density, 4 / 3 * jnp.pi * r**3, "a sphere")
    return Part(m, vector(at, "The centre of a sphere", "m"), 0.4 * m * r**2 * jnp.eye(3))


def _mass(
    mass: Numbers | None, density: Numbers | None, volume: Float[Array, ""], what: str
) -> Float[Array, ""]:
    if mass is not None and density is None:
        return positive(mass, f"The mass of {what}", "kg")
    if density is not None and mass is None:
        return positive(density, f"The density of {what}", "kg/m^3") * volume
    raise ModelError(f"Give either the mass or the density of {what}.")


def _between(
    start: Numbers, end: Numbers, what: str
) -> tuple[Float[Array, "3"], Float[Array, "3"], Float[Array, ""]]:
    """Middle of two points, the vector from start to end, and its square."""
    a = vector(start, f"The start of a {what}", "m")
    b = vector(end, f"The end of a {what}", "m")
    along = b - a
    square = along @ along
    if concrete(square) and float(square) == 0:
        raise ModelError(f"The two ends of a {what} must differ, but both are {a.tolist()} m.")
    return 0.5 * (a + b), along, square


def _about(arm: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Inertia factor |a|^2 I - a a^T of a point mass at the arm a."""
    return (arm @ arm) * jnp.eye(3) - arm[:, None] * arm


def _of_body(body: Body) -> Part:
    R = rotation_matrix(body.orientation)
    tensor = R @ body.inertia @ R.T
    return Part(body.mass, jnp.asarray(body.com_position), 0.5 * (tensor + tensor.T))
