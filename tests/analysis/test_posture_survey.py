"""Survey over two coordinates of a five-bar linkage of own numbers: reach, torques and singular postures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

G, FEET, CRANK, ROD = 9.81, 0.2, 0.3, 0.45
MASSES = {"a": 0.5, "b": 0.6, "c": 0.7, "d": 0.8}
# Angles of the cranks in the reference posture, where the joints' coordinates are zero.
START = np.array([2.0, 1.1])


def points(angles):
    """Feet, elbows and the point where the rods meet, above them, in the plane (x, z)."""
    feet = jnp.array([[-FEET, 0.0], [FEET, 0.0]])
    elbows = feet + CRANK * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=1)
    across = elbows[1] - elbows[0]
    square = across @ across
    up = jnp.sqrt(ROD**2 / square - 0.25) * jnp.stack([-across[1], across[0]])
    return feet, elbows, (elbows[0] + elbows[1]) / 2 + up


def five_bar(masses=MASSES):
    feet, elbows, tip = (np.asarray(p) for p in points(jnp.asarray(START)))
    place = lambda p: [p[0], 0.0, p[1]]
    ends = {
        "a": (feet[0], elbows[0]),
        "b": (feet[1], elbows[1]),
        "c": (elbows[0], tip),
        "d": (elbows[1], tip),
    }
    bodies = [
        stm.Body(name, masses[name], np.eye(3) * 1e-3, position=place((start + end) / 2))
        for name, (start, end) in ends.items()
    ]
    pins = [("A", "ground", "a", feet[0]), ("B", "ground", "b", feet[1]), ("C", "a", "c", elbows[0]),
            ("D", "b", "d", elbows[1]), ("P", "c", "d", tip)]  # fmt: skip
    joints = [
        stm.revolute(name, i, j, point=place(p), axis=[0.0, -1.0, 0.0]) for name, i, j, p in pins
    ]
    forces = [stm.Gravity([0.0, 0.0, -G]), stm.JointEffort("A", 0.0), stm.JointEffort("B", 0.0)]
    return stm.System(bodies, joints, forces)


def potential(angles):
    feet, elbows, tip = points(angles)
    heights = {
        "a": (feet[0] + elbows[0]), "b": (feet[1] + elbows[1]), "c": (elbows[0] + tip),
        "d": (elbows[1] + tip),
    }  # fmt: skip
    return G * sum(MASSES[name] * height[1] / 2 for name, height in heights.items())


def in_line(angles):
    """Sine of the angle between crank b and rod d: zero where that leg is stretched."""
    feet, elbows, tip = points(angles)
    crank, rod = elbows[1] - feet[1], tip - elbows[1]
    return (crank[0] * rod[1] - crank[1] * rod[0]) / (CRANK * ROD)


@pytest.mark.slow
def test_survey_of_a_five_bar_linkage():
    found = stm.analysis.survey(
        five_bar(), ["A.angle", "B.angle"], [(-1.5, 1.5), (-1.4, 1.2)], samples=15, body="c"
    )
    turned = np.stack(np.meshgrid(found.first, found.second, indexing="ij"), axis=-1)
    angles = jnp.asarray(START + turned)
    elbows = jax.vmap(jax.vmap(lambda x: points(x)[1]))(angles)
    distance = np.linalg.norm(elbows[:, :, 1] - elbows[:, :, 0], axis=-1)
    # a straight path from the start that leaves the reach ends there
    shares = np.linspace(0.0, 1.0, 60)[:, None, None, None]
    path = jnp.asarray(START + shares * turned)
    ends = jax.vmap(jax.vmap(jax.vmap(lambda x: points(x)[1])))(path)
    along = np.linalg.norm(ends[..., 1, :] - ends[..., 0, :], axis=-1)
    assert np.all(distance[found.reachable] <= 2 * ROD)
    assert np.all(found.reachable[np.max(along, axis=0) < 2 * ROD - 0.01])
    assert 0 < np.sum(~found.reachable) < 0.5 * found.reachable.size
    # torques by virtual work; near the limit of the reach Newton's method leaves 1e-9
    inside = found.reachable & (np.max(along, axis=0) < 2 * ROD - 0.05)
    torques = jax.vmap(jax.vmap(jax.grad(potential)))(angles)
    np.testing.assert_allclose(found.values[inside], torques[inside], rtol=1e-7, atol=1e-9)
    assert np.nanmax(found.unbalanced) < 1e-9
    assert np.isnan(found.values[~found.reachable]).all()
    # rods in line, at the limit of the reach or with coinciding elbows, do not hold the tip
    sine = distance * np.sqrt(np.maximum(4 * ROD**2 - distance**2, 0.0)) / (2 * ROD**2)
    least = np.unravel_index(np.nanargmin(found.conditioning), sine.shape)
    assert sine[least] < 0.2 * np.median(sine[found.reachable])
    # leg b and d in line: rod c moves in one direction less
    bent = np.asarray(jax.vmap(jax.vmap(in_line))(angles))
    straight = np.abs(bent) < 0.05
    assert np.sum(straight & inside) > 0
    assert np.max(found.mobility[straight & inside]) < 0.3 * np.nanmedian(found.mobility)
    # other numbers of the same structure
    heavy = stm.analysis.survey(
        five_bar({name: 2 * mass for name, mass in MASSES.items()}), ["A.angle", "B.angle"],
        [(-1.5, 1.5), (-1.4, 1.2)], samples=15,
    )  # fmt: skip
    np.testing.assert_allclose(heavy.values[inside], 2 * found.values[inside], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_what_a_survey_refuses():
    with pytest.raises(stm.SettingError, match="names of two coordinates"):
        stm.analysis.survey(five_bar(), ["A.angle"], [(-1, 1)])
    with pytest.raises(stm.SettingError, match=r"name 'A', "):
        stm.analysis.survey(five_bar(), ["A", "B.angle"], [(-1, 1), (-1, 1)])
    with pytest.raises(stm.SettingError, match="no body 'e'"):
        stm.analysis.survey(five_bar(), ["A.angle", "B.angle"], [(-1, 1), (-1, 1)], body="e")
    with pytest.raises(stm.SettingError, match="two limits or a list of values"):
        stm.analysis.survey(five_bar(), ["A.angle", "B.angle"], [(-1,), (-1, 1)])


@pytest.mark.slow
@pytest.mark.parametrize("ends", [("ground", "b"), ("b", "ground")])
def test_start_of_a_survey_over_a_universal_joint(ends):
    body = stm.Body("b", 1.0, np.diag([1e-3, 2e-3, 3e-3]), position=[0.3, 0.2, -0.4])
    joint = stm.universal(
        "U", *ends, point=[0.0, 0.0, 0.0], axis_i=[1.0, 0.0, 0.0], axis_j=[0.0, 1.0, 0.0]
    )
    system = stm.System([body], [joint], [stm.Gravity([0.0, 0.0, -G])])
    survey = lambda start: stm.analysis.survey(
        system, ["U.angle_1", "U.angle_2"], [(-0.6, 0.5), (-0.3, 0.9)], samples=3, state=start
    )
    space = stm.TreeSpace(system)
    turned = space.retract(space.from_state(system.reference), jnp.array([0.4, -0.2, 0.0, 0.0]))
    # the load of gravity on the joint depends on the posture, wherever the survey begins
    found, same = survey(None).unbalanced, survey(space.to_state(turned)).unbalanced
    np.testing.assert_allclose(same, found, rtol=1e-12)
    assert np.ptp(found) > 0.1


@pytest.mark.slow
def test_survey_refuses_parts_of_a_rotation_vector():
    body = stm.Body("b", 1.0, np.eye(3) * 1e-3, position=[0.3, 0.2, -0.4])
    joint = stm.spherical("S", "ground", "b", point=[0.0, 0.0, 0.0])
    system = stm.System([body], [joint], [stm.Gravity([0.0, 0.0, -G])])
    with pytest.raises(stm.SettingError, match="part of a rotation vector"):
        stm.analysis.survey(system, ["S.rotation_x", "S.rotation_y"], [(-1, 1), (-1, 1)])
