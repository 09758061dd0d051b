"""Mass properties of the UAV's seven bodies, against their momentum."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers import np_rotation, random_quaternion

import stmuav_jax as stm
from stmuav_jax.dynamics.evaluation import momentum


def test_momentum_of_all_bodies_is_that_of_one_and_what_moves_in_it():
    """L about the centre of mass is R (J omega + h); without motion inside, h is zero."""
    system = stm.make_scene("uav_tracker", 2).system
    rng = np.random.default_rng(3)
    r, p = rng.normal(size=(7, 3)), np.array([random_quaternion(rng) for _ in range(7)])
    of = jax.jit(lambda s: (momentum(system, s), *stm.uav.mass_properties(system, s)[1:4]))
    R = [np_rotation(each) for each in p]
    for moving in (False, True, True):
        omega_w = rng.normal(size=(7, 3)) if moving else np.tile(rng.normal(size=3), (7, 1))
        v = rng.normal(size=(7, 3)) if moving else np.cross(omega_w, r) + np.array([1.0, -2.0, 0.5])
        omega = np.array([A.T @ w for A, w in zip(R, omega_w, strict=True)])
        state = stm.State(*map(jnp.asarray, (r, p, v, omega)))
        (linear, angular), c, J, h = (np.split(of(state)[0], 2), *map(np.asarray, of(state)[1:]))
        about_centre = angular - np.cross(r[0] + R[0] @ c, linear)
        np.testing.assert_allclose(about_centre, R[0] @ (J @ omega[0] + h), rtol=0, atol=1e-13)
        assert (np.linalg.norm(h) > 1e-3) == moving
