"""Starts in singular postures: refused at rest, followed where velocities say along which branch."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import parallelogram, state_of

import stmuav_jax as stm
from stmuav_jax.dynamics.diagnostics import inspect_start

ALONG = (9.81, 0.0, 0.0)  # m/s^2, along the rods


class Ramp(eqx.Module):
    """Force along z that grows at a rate [N/s]."""

    rise: Any

    def __call__(self, t, kinematics):
        return self.rise * t * jnp.array([0.0, 0.0, 1.0])


def flat(rate=0.0, coupler=0.0, *, gravity=(0.0, 0.0, -9.81), pushes=(0.0, 0.0)):
    """The parallelogram in line, its crank and coupler turning, pushed up ever harder [N/s]."""
    forces = [
        stm.AppliedForce(body, Ramp(jnp.asarray(rise)), frame="world")
        for body, rise in zip(("crank", "coupler"), pushes, strict=True)
    ]
    system = parallelogram(0.0, gravity=gravity, forces=tuple(forces))
    rest, rocker = system.reference, rate + 2 * coupler
    omega = -np.outer([rate, coupler, rocker], [0.0, 1.0, 0.0])
    v = np.outer([rate / 2, rate + coupler, rocker / 2], [0.0, 0.0, 1.0])
    return system, state_of(rest.r, rest.p, v, omega)


@pytest.mark.slow
def test_a_start_at_rest_in_a_singular_posture_is_refused():
    """Before anything is integrated, by the same words whatever the method."""
    messages = set()
    ways: tuple[dict[str, Any], ...] = (
        {},
        {"method": stm.Method(formulation=stm.Augmented())},
        {"analysis": False, "throw": False},
        {"method": stm.Method(stabilisation=stm.Baumgarte(10.0, 10.0, 10.0))},
    )
    for how in ways:
        with pytest.raises(
            stm.StateError, match=r"^The start is a singular posture of "
        ) as refused:
            stm.simulate(*flat(), t1=0.2, **how)
        messages.add(str(refused.value))
    (words,) = messages
    assert all(f"{joint} (at 0 rad)" in words for joint in "ABCD")
    assert "branches of the motion meet there, and nothing determines which one it follows" in words
    assert "Start near that posture" in words
    # as slow as round-off is no velocity
    with pytest.raises(stm.StateError, match="velocities up to 1e-06 rad/s"):
        stm.simulate(*flat(1e-7), t1=0.2)


@pytest.mark.slow
def test_singular_postures_of_any_size_are_found():
    for size in (1e-4, 1.0, 1e5):
        start = lambda angle, size=size: parallelogram(angle, size=size)
        with pytest.raises(stm.StateError, match="singular posture"):
            inspect_start(start(0.0), start(0.0).reference, 0.0, stm.Tree())
        for angle in (0.3, 1e-3):
            *_, found = inspect_start(start(angle), start(angle).reference, 0.0, stm.Tree())
            assert found.branches == ""
            assert not found.followed


def test_a_structure_that_can_only_shake_is_refused_where_it_is_pushed():
    """Two rods in line hold their point; across them no first-order term does."""

    def held(gravity):
        body = stm.Body("knot", 1.0, (0.1, 0.1, 0.1))
        rods = [
            stm.distance(
                f"rod{x:+d}", "ground", "knot", point_i=(float(x), 0, 0), point_j=(0, 0, 0)
            )
            for x in (-1, 1)
        ]
        return stm.System([body], rods, [stm.Gravity(gravity)])

    with pytest.raises(stm.StateError, match=r"singular posture of rod[+-]1, rod[+-]1: "):
        inspect_start(held((0.0, 0.0, -9.81)), held(ALONG).reference, 0.0, stm.Tree())
    *_, found = inspect_start(held(ALONG), held(ALONG).reference, 0.0, stm.Tree())
    assert "rod+1" in found.branches


@pytest.mark.slow
def test_runs_through_and_from_a_singular_start():
    """Velocities choose the branch, balance keeps to the posture; what leaves it later says so."""
    how: Any = {"t1": 0.2, "save_every": 0.05}
    # on the first branch the coupler does not turn; on the other it turns twice as fast, backwards
    for coupler in (0.0, -2.0):
        run = stm.simulate(*flat(1.0, coupler), **how)
        assert run.certificate.error_words == ""
        assert run.certificate.relative_energy_error < 1e-8
        turned = np.asarray(run.states.omega)[:, 1, 1]
        assert np.all(np.abs(turned) < 1e-9) if coupler == 0 else np.all(turned > 1)
    still = stm.simulate(*flat(gravity=ALONG), **how)
    assert still.certificate.error_words == ""
    assert np.max(np.abs(still.states.omega)) < 1e-9
    # a push in the middle, or on a crank alone, moves the cranks alike: one of two branches, which is said
    for pushes in ((0.0, 5.0), (5.0, 0.0)):
        moved = stm.simulate(*flat(gravity=ALONG, pushes=pushes), **how)
        words = moved.certificate.error_words
        assert words.startswith("The start is a singular posture of ")
        assert "branch that this run follows" in words
        turned = np.asarray(moved.states.omega)[:, :, 1]
        assert np.all(turned[1:, 0] < -1e-3)
        np.testing.assert_allclose(turned[:, 2], turned[:, 0], atol=1e-12)
        assert np.max(np.abs(turned[:, 1])) < 1e-12
        assert moved.certificate.position_violation < 1e-12
