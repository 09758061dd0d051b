"""States between saved times are as good as the steps."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum

from stmuav_jax import Method, Scene, SettingError, State, simulate
from stmuav_jax.dynamics import states_at


@pytest.fixture(scope="module")
def swing():
    system = pendulum(length=0.5)
    rest = system.reference
    moving = State(rest.r, rest.p, jnp.array([[-1.0, 0, 0]]), jnp.array([[0, 2.0, 0]]))
    scene = Scene("p", "p", system, moving, t1=0.5, save_every=0.1)
    return simulate(scene, method=Method(rtol=1e-11, atol=1e-11))


def test_between_saved_times_as_accurate_as_on_them(swing):
    times = np.array([0.0, 0.05, 0.123, swing.ts[3], 0.49, 0.5])
    found = states_at(swing, times)
    direct = simulate(swing.scene, method=Method(rtol=1e-11, atol=1e-11), ts=times)
    for name in ("r", "p", "v", "omega"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(direct.states, name), rtol=0, atol=1e-9
        )
    assert np.abs(np.diff(found.r[:, 0, 0])).min() > 1e-3
    np.testing.assert_array_equal(found.r[3], np.asarray(swing.states.r)[3])


def test_outside_the_run_is_refused(swing):
    with pytest.raises(SettingError, match=r"covers 0 s to 0\.5 s, but a state at 0\.6 s"):
        states_at(swing, [0.2, 0.6])
