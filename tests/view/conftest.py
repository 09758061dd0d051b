"""One short run, shared by the tests of files and figures."""

import pytest

from stmuav_jax import make_scene, simulate


@pytest.fixture(scope="session")
def short_run():
    return simulate(make_scene("uav_tracker", 2), t1=0.05, save_every=0.01)
