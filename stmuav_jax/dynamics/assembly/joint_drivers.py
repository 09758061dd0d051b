"""Drivers that hold the coordinates of joints at given values, or move them at given rates."""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.rotation import from_rotation_vector, rotation_matrix
from ...checks.errors import ModelError
from ...mechanics.joint import CATALOGUE, Joint
from ...mechanics.joint_states import coordinates_of
from ...mechanics.motions.base import CYCLIC
from ...mechanics.motions.sequence import turning
from ...mechanics.motions.spherical import SPHERICAL
from ...mechanics.system import System


class UniformMotion(eqx.Module):
    """Linear motion of a driver: value + rate (t - t0)."""

    value: Float[Array, ""]
    rate: Float[Array, ""]
    t0: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.value + self.rate * (t - self.t0)


def with_drivers(
    system: System, q: dict[str, Array], u: dict[str, Array], t: Float[Array, ""]
) -> System:
    """System with drivers for every coordinate of the given joints."""
    drivers: list[Joint] = []
    for name, value in q.items():
        joint = system.joints[system.joint_index(name)]
        for word, kind, frames, x, x_rate in _drivers(joint, value, u[name]):
            (i, frame_i), (j, frame_j) = frames
            sides = {"i": (joint.body_i, joint.point_i), "j": (joint.body_j, joint.point_j)}
            drivers.append(
                dataclasses.replace(
                    joint,
                    name=f"{name}, given {word}",
                    kind=f"drive_{kind}",
                    body_i=sides[i][0],
                    body_j=sides[j][0],
                    point_i=sides[i][1],
                    point_j=sides[j][1],
                    frame_i=frame_i,
                    frame_j=frame_j,
                    motion=UniformMotion(x, x_rate, t),
                )
            )
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *drivers))


def _drivers(joint: Joint, q: Array, u: Array) -> list[Any]:
    """Drivers of a joint's coordinates: name, kind, two frames with their sides, value and rate.

    The row of an angle measures it from the x axis of the first frame to that of the second,
    positive towards the first frame's y axis.

    Raises:
        ModelError: there are no such rows for the coordinates of this kind of joint.
    """
    F_i, F_j = joint.frame_i, joint.frame_j
    motions = CATALOGUE[joint.kind].motion or ()
    turns = [axis for motion, axis, _ in motions if turning(motion)]
    rows: list[Any] = []
    for motion, axis, _ in motions:
        x, x_rate, order = q[len(rows) :], u[len(rows) :], list(CYCLIC[axis])
        same = (("i", F_i[:, order]), ("j", F_j[:, order]))
        seen = [kind for kind, *_ in rows]
        if len(motion.columns) == 1 and not turning(motion) and "angle" not in seen:
            rows.append(("displacement", same, x[0], x_rate[0]))
        elif len(motion.columns) == 1 and turns in ([axis], [axis, CYCLIC[axis][0]]):
            rows.append(("angle", same, x[0], x_rate[0]))
        elif len(motion.columns) == 1 and turns == [CYCLIC[axis][1], axis]:
            first, third = CYCLIC[axis][1], CYCLIC[axis][0]
            back = jnp.stack([F_j[:, first], F_j[:, third], -F_j[:, axis]], axis=1)
            rows.append(
                ("angle", (("j", back), ("i", F_i[:, [first, axis, third]])), x[0], x_rate[0])
            )
        elif motion is SPHERICAL and turns == [axis]:
            # frame i turned to the given orientation: there the rates are those of three angles
            turn = rotation_matrix(from_rotation_vector(x[:3]))
            at, w = F_i @ turn, turn.T @ x_rate[:3]
            for a, cyclic in CYCLIC.items():
                frames = (("i", at[:, list(cyclic)]), ("j", F_j[:, list(cyclic)]))
                rows.append(("angle", frames, jnp.zeros_like(q[0]), w[a]))
        else:
            raise ModelError(
                f"In a mechanism with loops the coordinates of joint '{joint.name}' cannot be given, "
                f"as no rows prescribe those of a {joint.kind} joint: name other joints."
            )
    names = [word for word, _ in coordinates_of(joint.kind)]
    return [(name, *row) for name, row in zip(names, rows, strict=True)]
