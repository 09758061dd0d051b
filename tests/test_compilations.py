"""A public function called again with other numbers compiles nothing, for any mechanism."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

MODELS = Path(__file__).parents[1] / "docs" / "models"
_COMPILE = "/jax/core/compile/backend_compile_duration"


@contextmanager
def counted_compilations() -> Iterator[list[str]]:
    """List to which every program that XLA compiles in the meantime is added."""
    events: list[str] = []

    def listen(event: str, duration_secs: float, **kwargs: str | int) -> None:
        del duration_secs
        if event == _COMPILE:
            events.append(str(kwargs.get("fun_name", "")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield events
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def check_compiled_once(function, first, second):
    """Call a function with two sets of numbers, the second of which must compile nothing."""
    a = function(first)
    with counted_compilations() as events:
        b = function(second)
    assert events == [], events
    changed = [
        np.any(np.asarray(x) != np.asarray(y))
        for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True)
    ]
    assert any(changed), "The second call has to have other numbers."


def test_the_count_sees_a_compilation():
    with counted_compilations() as events:
        jax.jit(lambda x: 3.0 * x + 1.0)(jnp.ones(7)).block_until_ready()
    assert len(events) > 0


@pytest.fixture(scope="module")
def four_bar():
    scene = stm.io.load_model(MODELS / "four_bar.toml")
    space = stm.TreeSpace(scene.system, scene.state0)
    start = space.from_state(scene.state0)
    points = [
        space.retract(start, jnp.array([angle, rate])) for angle, rate in ((0.0, 0.1), (0.02, 0.3))
    ]
    return space, points


@pytest.mark.parametrize("method", ["to_state", "with_closed_loops", "conditioning", "rates"])
def test_state_space_of_a_closed_loop(four_bar, method):
    space, points = four_bar
    check_compiled_once(getattr(space, method), *points)


def test_clearances_of_a_closed_loop(four_bar):
    space, points = four_bar
    compare = lambda x: stm.analysis.compare_clearances(
        space.system, [space.system.joints[0].name], space.system.names[-1], space.to_state(x)
    )
    check_compiled_once(compare, *points)


def test_linearisation_of_a_closed_loop(four_bar):
    space, points = four_bar
    matrices = lambda x: (lambda linear: (linear.A, linear.B))(stm.linearize(space, x))
    check_compiled_once(matrices, *points)


def test_trim_of_a_closed_loop(four_bar):
    space, points = four_bar
    still = [space.retract(x, jnp.array([0.0, -float(x.u[0])])) for x in points]
    check_compiled_once(lambda x: stm.trim(space, at=x).values, *still)


def test_steady_flight_of_a_multirotor():
    scene = stm.make_scene("hexacopter")
    space = stm.TreeSpace(scene.system, scene.state0)
    at = space.from_state(scene.state0)

    def trimmed(yaw: float):
        return stm.analysis.trim_condition(space, stm.analysis.hover(yaw=yaw), at=at).point.p

    check_compiled_once(trimmed, 0.1, 0.3)


@pytest.mark.slow
def test_trim_and_linearisation_of_the_uav():
    uav = stm.uav.make_uav()

    def compute(angle: float):
        trim = stm.uav.trim_flight(uav, stm.analysis.hover(np.array([angle, 0.1])))
        linear = stm.linearize(uav.space, trim.point, uav.inputs, trim.values)
        return trim.values, linear.A, linear.B

    check_compiled_once(compute, 0.1, 0.2)
