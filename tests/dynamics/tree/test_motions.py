"""Relative motions: one class is all that a new one takes; here a planar one."""

import dataclasses
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import inertia_of, random_quaternion, relative_error

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.stabilisation import Unstabilised
from stmuav_jax.math.stacked import apply_matrix, apply_transposed, multiply_matrices
from stmuav_jax.mechanics.joint import CATALOGUE, Freedom, JointKind, Term, X, Y, Z
from stmuav_jax.mechanics.motions import AbstractRelativeMotion, MotionColumn, RelativePose

SAME = 1e-11


@dataclasses.dataclass(frozen=True)
class Planar(AbstractRelativeMotion):
    """Displacements in the plane of x and y and the angle about z; u in the axes behind."""

    positions: ClassVar[tuple[int, ...]] = (3,)
    velocities: ClassVar[tuple[int, ...]] = (3,)
    unit_norm: ClassVar[bool] = False
    flat: ClassVar[bool] = False

    name: str = "planar"

    @property
    def coordinates(self):
        return ("x", "m"), ("y", "m"), ("angle", "rad")

    @property
    def columns(self):
        return MotionColumn(0, 0.0, 1.0), MotionColumn(1, 0.0, 1.0), MotionColumn(2, 1.0, 0.0)

    def _rotation(self, angle):
        c, s, none = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
        return jnp.stack(
            [
                jnp.stack([c, -s, none]),
                jnp.stack([s, c, none]),
                jnp.stack([none, none, none + 1]),
            ]
        )

    def _flat(self, q):
        return jnp.stack([q[0], q[1], jnp.zeros_like(q[0])])

    def relative(self, q, K, k, shares):
        return multiply_matrices(K, self._rotation(q[2])), k + apply_matrix(K, self._flat(q))

    def _turned(self, angle):
        none = jnp.zeros_like(angle)
        return jnp.stack([jnp.cos(angle / 2), none, none, jnp.sin(angle / 2)])

    def euler_parameters(self, q, shares):
        return self._turned(q[2])

    def read(self, frames, shares):
        angle = jnp.arctan2(frames.rotation[1, 0], frames.rotation[0, 0])
        return jnp.stack([*frames.offset[:2], angle]), self._rotation(angle), frames.offset

    def rates(self, q, u):
        return apply_matrix(self._rotation(q[2]), self._flat(u)).at[2].set(u[2])

    def retract(self, q, step):
        return q + self.rates(q, step)

    def difference(self, y, x):
        step = y - x
        return apply_transposed(self._rotation(x[2]), self._flat(step)).at[2].set(step[2])

    def pose(self, x, x_rate, axis, pitch):
        p = self._turned(x[2])
        turning = jnp.zeros(3).at[2].set(x_rate[2])
        return RelativePose(p, self._flat(x), turning, self._flat(x_rate))


PLANAR = JointKind((Term("n1", X, Z), Term("n1", Y, Z), Term("n2", Z)), (Freedom(Planar()),))


def planar(name, i, j, *, point, axis):
    return dataclasses.replace(stm.revolute(name, i, j, point=point, axis=axis), kind="planar")


@pytest.mark.slow
def test_a_motion_of_ones_own(monkeypatch):
    """Tree and maximal coordinates agree on a chain and a loop with a planar joint."""
    monkeypatch.setitem(CATALOGUE, "planar", PLANAR)
    rng = np.random.default_rng(4)
    bodies = [
        stm.Body(
            name,
            1 + rng.random(),
            inertia_of(rng),
            com=0.05 * rng.normal(size=3),
            position=0.2 * rng.normal(size=3),
            orientation=random_quaternion(rng),
        )
        for name in "abc"
    ]
    joints = [
        planar("P", "ground", "a", point=[0, 0, 0.1], axis=[1.0, 0, 2]),
        stm.screw("H", "b", "a", point=[0.3, 0, 0], axis=[0, 1.0, 1], pitch=0.1),
        planar("Q", "c", "b", point=[0.3, 0.4, 0], axis=[0.0, 1, 0]),
        stm.distance("D", "ground", "c", point_i=[0.1, 0, 0.9], point_j=[0.2, 0.1, 0.1]),
    ]
    system = stm.System(bodies, joints, [stm.Gravity()])
    start = system.reference
    v, omega = jnp.asarray(rng.normal(size=(2, 3, 3)))
    state = stm.assemble(system, stm.State(start.r, start.p, v, omega)).state
    tree, t = stm.Tree(), jnp.asarray(0.1)
    model = tree.prepare(system)
    assert model.parameters.tree.n_velocities == 7

    @jax.jit
    def look(state):
        found = [
            stm.dynamics.evaluate(system, state, t, formulation=f) for f in (stm.Augmented(), tree)
        ]
        x = tree.to_vector(model, state)
        rate, _ = tree.derivative(model, t, x, Unstabilised())
        slope = jax.jvp(lambda x: tree.to_state(model, x), (x,), (rate,))[1]
        return found, tree.to_state(model, x), slope, tree.project(model, t, x, 3)[1]

    found, back, slope, left = look(state)
    one, other = (f.accelerations for f in found)
    for name in ("r", "v", "omega"):
        assert relative_error(getattr(back, name), getattr(state, name)) < SAME
    assert relative_error(slope.r, state.v) < SAME
    for got in (other, slope):
        ours = (got.v_rate, got.omega_rate) if got is other else (got.v, got.omega)
        assert relative_error(ours[0], one.v_rate) < SAME
        assert relative_error(ours[1], one.omega_rate) < SAME
    assert left.position < 1e-13
