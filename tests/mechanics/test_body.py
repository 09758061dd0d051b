"""What a body may be: every number that no rigid body has is refused, by name."""

import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation, random_quaternion, turn

import stmuav_jax as stm

# AFRL-AFOSR-JP-TR-2019-0058, Part II, section 5.1, as printed: "866e-3" breaks the triangle
# inequality, 86.6e-3 does not. And Part I, Table 6.2, J'_7, rounded to 0.7 % too much.
PRINTED_UAV = np.array([[57.2, 0.492, -0.201], [0.492, 58.8, 0.0056], [-0.201, 0.0056, 866]]) * 1e-3
PRINTED_J7 = np.array([[0.0012, 0, 0.0001], [0, 0.0012, 0], [0.0001, 0, 0.0024]])


def body(mass: Any = 1.0, inertia: Any = (1.0, 1.0, 1.0), **more: Any) -> stm.Body:
    return stm.Body("wheel", mass, inertia, **more)


@pytest.mark.parametrize("mass", [np.nan, 0.0, -1.0, np.inf])
def test_mass_must_be_finite_and_positive(mass):
    with pytest.raises(stm.ModelError, match="mass of body 'wheel' must be finite and positive"):
        body(mass=mass)


def test_mass_must_be_a_number():
    with pytest.raises(stm.ModelError, match=r"mass of body 'wheel' must have shape \(\)"):
        body(mass=[1.0, 2.0])


@pytest.mark.parametrize(
    ("tensor", "words"),
    [
        (np.diag([1, 1, np.nan]), "must be finite"),
        ([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]], "must be symmetric"),
        ([1.0, 1.0, 0.0], "must be positive definite"),
        ([[1, 2, 0], [2, 1, 0], [0, 0, 1]], "must be positive definite"),
        ([1.0, 1.0, 2.0 + 1e-9], "triangle inequality"),
        ([1.0, 1.0], r"must have shape \(3, 3\)"),
    ],
)
def test_inertia_that_no_body_has(tensor, words):
    with pytest.raises(stm.ModelError, match=words) as error:
        body(inertia=tensor)
    assert "'wheel'" in str(error.value)


@pytest.mark.parametrize(
    ("formulation", "tensor"),
    [(stm.Tree(), np.diag([1.0, -1.0, 1.0])), (stm.Augmented(), np.diag([1.0, 1.0, np.nan]))],
    ids=["tree", "augmented"],
)
def test_a_tensor_that_is_replaced_later_is_refused_in_the_same_words(formulation, tensor):
    with pytest.raises(stm.ModelError) as of_body:
        body(inertia=tensor)
    system = stm.System([body(free=True)], [], [])
    changed = eqx.tree_at(lambda s: s.bodies.inertia, system, jnp.asarray(tensor)[None])
    with pytest.raises(stm.ModelError, match=re.escape(str(of_body.value))):
        stm.dynamics.evaluate(changed, system.reference, formulation=formulation)
    with pytest.raises(stm.ModelError, match=re.escape(str(of_body.value))):
        stm.simulate(
            changed, system.reference, ts=[0.0, 0.1], method=stm.Method(formulation=formulation)
        )


def test_the_reports_printed_tensor_is_refused_and_its_correction_accepted():
    with pytest.raises(stm.ModelError, match="triangle inequality") as error:
        body(inertia=PRINTED_UAV)
    assert "'wheel'" in str(error.value)
    right = PRINTED_UAV.copy()
    right[2, 2] = 86.6e-3
    np.testing.assert_array_equal(body(inertia=right).inertia, right)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("moments", [(1, 2, 3), (1, 1, 1), (1, 1, 2), (2, 5, 4), (1e-9, 1, 1)])
def test_equality_is_accepted_in_any_axes(moments, seed):
    """A flat body has J_z = J_x + J_y exactly; round-off of a rotation must not matter."""
    R = np_rotation(random_quaternion(np.random.default_rng(seed)))
    tensor = R @ np.diag(np.array(moments, dtype=float)) @ R.T
    assert body(inertia=0.5 * (tensor + tensor.T)).inertia.shape == (3, 3)


@pytest.mark.parametrize("seed", range(2))
def test_turned_tensors_are_judged_by_their_eigenvalues(seed):
    """The diagonal of this turned tensor looks fine; the principal moments do not."""
    R = np_rotation(random_quaternion(np.random.default_rng(10 + seed)))
    tensor = R @ np.diag([0.5, 0.5, 1.2]) @ R.T
    with pytest.raises(stm.ModelError, match="exceeds the sum of the other two by 20 %"):
        body(inertia=0.5 * (tensor + tensor.T))


def test_triangle_tolerance_admits_a_rounded_table():
    with pytest.raises(stm.ModelError, match=r"by 0\.69\d* %") as error:
        body(inertia=PRINTED_J7)
    advised = re.search(r"triangle_tolerance=([0-9.e+-]+)\.", str(error.value))
    assert advised is not None
    assert body(inertia=PRINTED_J7, triangle_tolerance=float(advised[1])).mass == 1
    assert body(inertia=PRINTED_J7, triangle_tolerance=0.007).mass == 1
    with pytest.raises(stm.ModelError, match="triangle"):
        body(inertia=PRINTED_J7, triangle_tolerance=0.006)
    with pytest.raises(stm.ModelError, match="triangle"):
        body(inertia=PRINTED_UAV, triangle_tolerance=0.007)


@pytest.mark.parametrize(
    ("p", "words"),
    [
        ([0.0, 0, 0, 0], "all zero"),
        ([1.0, 0, 0, np.nan], "must be finite"),
        ([0.9768, -0.1317, -0.1524, 0.0188], "has norm 0.997528"),
        ([1.0 + 1e-8, 0, 0, 0], "must have norm 1"),
        ([1.0, 0, 0], r"must have shape \(4,\)"),
    ],
)
def test_euler_parameters_must_be_unit(p, words):
    with pytest.raises(stm.ModelError, match=words) as error:
        body(orientation=p)
    assert "'wheel'" in str(error.value)


def test_euler_parameters_within_round_off_are_kept_as_given():
    p = np.array([1 + 5e-10, 0, 0, 0])
    np.testing.assert_array_equal(body(orientation=p).orientation, p)


@pytest.mark.parametrize("field", ["com", "position"])
@pytest.mark.parametrize("value", [[0.0, np.nan, 0.0], [np.inf, 0, 0], [0.0, 0.0]])
def test_places_must_be_finite(field, value):
    with pytest.raises(stm.ModelError, match="'wheel' must"):
        body(**{field: value})


@pytest.mark.parametrize("name", ["", "ground"])
def test_reserved_names(name):
    with pytest.raises(stm.ModelError, match="cannot be named"):
        stm.Body(name, 1.0, [1, 1, 1])


def test_centre_of_mass_in_the_world():
    p = turn([0, 0, 1], np.pi / 2)
    made = body(com=[1, 0, 0], position=[0, 0, 3], orientation=p)
    np.testing.assert_allclose(made.com_position, [0, 1, 3], atol=1e-15)


def test_checks_do_not_stop_a_trace():
    """Inside a transformation values are unknown: no check, and gradients flow."""
    moment = lambda m: jnp.sum(stm.Body("b", m, jnp.stack([m, m, m])).inertia)
    assert float(jax.grad(moment)(2.0)) == 3
    assert float(jax.jit(moment)(2.0)) == 6


@pytest.mark.parametrize(
    ("moments", "words"),
    [
        ([0.0, 1.0, 1.0], r"A rod without thickness .* m r\^2 / 2"),
        ([0.0, 0.0, 0.0], "A point mass has no inertia"),
    ],
)
def test_ideal_bodies_are_refused_by_their_own_names(moments, words):
    for seed in range(3):
        R = np_rotation(random_quaternion(np.random.default_rng(seed)))
        tensor = R @ np.diag(moments) @ R.T
        with pytest.raises(stm.ModelError, match=words):
            body(inertia=0.5 * (tensor + tensor.T))
    with pytest.raises(stm.ModelError) as error:
        body(inertia=[-1.0, 1.0, 1.0])
    assert "rod" not in str(error.value)
    assert "point mass" not in str(error.value)


def test_of_a_traced_tensor_the_symmetric_part_counts():
    """So a derivative with respect to the whole tensor is symmetric, whatever is done with it."""
    omega = jnp.array([1.0, -2.0, 0.5])
    spin = lambda tensor: (body(inertia=tensor).inertia @ omega)[0]
    tensor = jnp.diag(jnp.array([1.0, 2.0, 2.5])) + 0.1 * (1 - jnp.eye(3))
    gradient = jax.jit(jax.grad(spin))(tensor)
    np.testing.assert_array_equal(gradient, gradient.T)
    change = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 0]])
    assert float(jnp.sum(gradient * change)) == pytest.approx(-2.0)
    np.testing.assert_array_equal(jax.jit(lambda x: body(inertia=x).inertia)(tensor), tensor)
