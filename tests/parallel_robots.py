"""Parallel robots and linkages of own numbers, with their singular postures known by hand."""

from typing import Any

import numpy as np

import stmuav_jax as stm

G = 9.81
BASE, TOP, HEAVY, LIGHT = 0.5, 0.3, 8.0, 0.7


def three_rps(height, mass=HEAVY):
    """Platform on three legs, each a hinge on the base, a pushed slide and a ball on the platform.

    The hinges' axes are tangents of the base circle. With the platform's balls in the base plane, at zero
    height, the legs lie flat and carry no vertical force.
    """
    bodies = [stm.Body("platform", mass, np.diag([0.1, 0.1, 0.2]), position=[0.0, 0.0, height])]
    joints: list[Any] = []
    forces: list[Any] = [stm.Gravity([0.0, 0.0, -G])]
    for k in range(3):
        turn = 2 * np.pi * k / 3
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        foot, head = BASE * out, TOP * out + [0.0, 0.0, height]
        axis = (head - foot) / np.linalg.norm(head - foot)
        for name, share in (("barrel", 0.25), ("rod", 0.75)):
            place = foot + share * (head - foot)
            bodies.append(stm.Body(f"{name}_{k}", LIGHT, np.eye(3) * 0.004, position=place))
        joints += [
            stm.revolute(f"R{k}", "ground", f"barrel_{k}", point=foot, axis=np.cross(out, [0, 0, 1.0])),
            stm.translational(f"P{k}", f"barrel_{k}", f"rod_{k}", point=(foot + head) / 2, axis=axis),
            stm.spherical(f"S{k}", f"rod_{k}", "platform", point=head),
        ]  # fmt: skip
        forces.append(stm.JointEffort(f"P{k}", 0.0))
    return stm.System(bodies, joints, forces)


CRANK, ROD = 0.1, 0.3


def slider_crank(angle, pushed):
    """Crank, rod and slider along x; the crank's hinge "O" or the slider's joint "slide" is pushed."""
    a = CRANK * np.array([np.cos(angle), 0.0, np.sin(angle)])
    x = a[0] + np.sqrt(ROD**2 - a[2] ** 2)
    b = np.array([x, 0.0, 0.0])
    tensor = np.eye(3) * 1e-3
    bodies = [
        stm.Body("crank", 0.4, tensor, position=a / 2),
        stm.Body("rod", 0.5, tensor, position=(a + b) / 2),
        stm.Body("slider", 0.8, tensor, position=b),
    ]
    axis = [0.0, -1.0, 0.0]
    joints = [
        stm.revolute("O", "ground", "crank", point=[0.0, 0.0, 0.0], axis=axis),
        stm.revolute("A", "crank", "rod", point=a, axis=axis),
        stm.spherical("B", "rod", "slider", point=b),
        stm.translational("slide", "ground", "slider", point=b, axis=[1.0, 0.0, 0.0]),
    ]
    return stm.System(bodies, joints, [stm.Gravity([0.0, 0.0, -G]), stm.JointEffort(pushed, 0.0)])
