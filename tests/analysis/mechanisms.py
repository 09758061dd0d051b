"""Mechanisms that are not the report's, for tests of what works on any."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import stmuav_jax as stm

G = 9.81


def cart_pole(mass: Any = 2.0, bob: Any = 0.5, length: Any = 0.8, inertia=0.02, damping=None):
    """A cart on a rail along x, driven by a force, with a pole that stands upright at zero.

    The damping of the hinge [N m s] is left out where it is None.
    """
    cart = stm.Body("cart", mass, np.eye(3) * 0.1)
    pole = stm.Body("pole", bob, np.diag([inertia, inertia, 1e-3]), position=[0.0, 0.0, length])
    joints = [
        stm.translational("rail", "ground", "cart", point=[0.0, 0.0, 0.0], axis=[1.0, 0.0, 0.0]),
        stm.revolute("hinge", "cart", "pole", point=[0.0, 0.0, 0.0], axis=[0.0, 1.0, 0.0]),
    ]
    forces = [stm.Gravity([0.0, 0.0, -G]), stm.JointEffort("rail", 0.0)]
    if damping is not None:
        forces.append(stm.mechanics.JointDamping("hinge", turning=damping))
    return stm.System([cart, pole], joints, forces)


def pendulum(mass: Any = 1.2, com: Any = 0.3, inertia: Any = 0.02):
    """A body on a hinge with its centre of mass at a distance below it, turned by a torque."""
    body = stm.Body(
        "rod", mass, jnp.eye(3) * jnp.asarray(inertia), com=-jnp.asarray(com) * jnp.eye(3)[2]
    )
    hinge = stm.revolute("hinge", "ground", "rod", point=[0.0, 0.0, 0.0], axis=[0.0, 1.0, 0.0])
    return stm.System([body], [hinge], [stm.Gravity([0.0, 0.0, -G]), stm.JointEffort("hinge", 0.0)])


CRANK, COUPLER, ROCKER, BASE = 0.3, 0.9, 0.7, 0.8
MASSES = (1.0, 2.0, 1.5)
INERTIAS = (0.01, 0.15, 0.07)


def pins(angle):
    """Pin joints in the plane (x, z): crank and coupler, coupler and rocker."""
    a = np.array([CRANK * np.cos(angle), CRANK * np.sin(angle)])
    b = np.array([BASE, 0.0])
    d = b - a
    r = np.hypot(*d)
    along = (COUPLER**2 - ROCKER**2 + r**2) / (2 * r)
    up = np.sqrt(COUPLER**2 - along**2)
    return a, a + (along * d + up * np.array([-d[1], d[0]])) / r


def four_bar(angle=1.0, torque=0.0, masses=MASSES, damping=None):
    """Three bars on two pins of the ground, assembled at a crank angle."""
    a, c = pins(angle)
    ends = [(np.zeros(2), a), (a, c), (np.array([BASE, 0.0]), c)]
    bodies = []
    for name, mass, inertia, (start, end) in zip(
        ("crank", "coupler", "rocker"), masses, INERTIAS, ends, strict=True
    ):
        middle = (start + end) / 2
        tensor = np.diag([inertia, inertia, inertia])
        bodies.append(stm.Body(name, mass, tensor, position=[middle[0], 0.0, middle[1]]))
    at = lambda p: [p[0], 0.0, p[1]]
    # a turn about -y goes from x to z
    axis = [0.0, -1.0, 0.0]
    joints = [
        stm.revolute("A", "ground", "crank", point=[0.0, 0.0, 0.0], axis=axis),
        stm.revolute("B", "crank", "coupler", point=at(a), axis=axis),
        stm.revolute("C", "coupler", "rocker", point=at(c), axis=axis),
        stm.revolute("D", "ground", "rocker", point=[BASE, 0.0, 0.0], axis=axis),
    ]
    forces = [stm.Gravity([0.0, 0.0, -G]), stm.JointEffort("A", torque)]
    if damping is not None:
        forces.append(stm.mechanics.JointDamping("D", turning=damping))
    return stm.System(bodies, joints, forces)


def stewart(mass: Any = 20.0, com: Any = (0.0, 0.0, 0.0)):
    """A platform on six legs of universal, translational and spherical joints, each pushed."""
    turn = lambda k, r, z, off: np.array(
        [r * np.cos(k * np.pi / 3 + off), r * np.sin(k * np.pi / 3 + off), z]
    )
    feet = [turn(k, 1.0, 0.0, 0.15 * (-1) ** k) for k in range(6)]
    heads = [turn(k, 0.6, 1.2, -0.25 * (-1) ** k) for k in range(6)]
    inertia = np.diag([1.0, 1.2, 1.8])
    bodies = [stm.Body("platform", mass, inertia, com=com, position=[0.0, 0.0, 1.25])]
    joints, efforts = [], []
    for k, (foot, head) in enumerate(zip(feet, heads, strict=True)):
        axis = (head - foot) / np.linalg.norm(head - foot)
        across = np.cross(axis, [0.0, 0.0, 1.0])
        across /= np.linalg.norm(across)
        other = np.cross(axis, across)
        for part, share, mass in (("barrel", 0.25, 0.8), ("rod", 0.75, 0.5)):
            place = foot + share * (head - foot)
            bodies.append(stm.Body(f"{part}_{k}", mass, np.eye(3) * 0.01, position=place))
        joints += [
            stm.universal(
                f"U{k}", "ground", f"barrel_{k}", point=foot, axis_i=across, axis_j=other
            ),
            stm.translational(
                f"T{k}", f"barrel_{k}", f"rod_{k}", point=(foot + head) / 2, axis=axis
            ),
            stm.spherical(f"S{k}", f"rod_{k}", "platform", point=head),
        ]
        efforts.append(stm.JointEffort(f"T{k}", 0.0))
    return (
        stm.System(bodies, joints, [stm.Gravity([0.0, 0.0, -G]), *efforts]),
        np.array(feet),
        np.array(heads),
    )
