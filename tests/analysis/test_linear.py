"""Modes of linear systems: shares of the states against derivatives of eigenvalues, clusters refused."""

import io
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from rich.console import Console

import stmuav_jax as stm
from stmuav_jax.cli.trim import count_modes_at_zero, modes_table

G = 9.81
# Central differences with one Richardson step: round-off over the step, and the fifth derivative.
DIFFERENCES = 1e-6


def linear_of(A, names=()):
    n = len(A)
    states = tuple((names[k] if names else f"s{k}", "1") for k in range(n))
    none = np.zeros((n, 0))
    return stm.analysis.Linear(np.asarray(A, float), none, np.eye(n), none, states, (), states)


def free_chain(masses, springs, drift=3):
    """Free masses in line, x'' = -M^-1 K x, with natural modes; beside them masses that drift."""
    n = len(masses)
    K = np.zeros((n, n))
    for k, spring in enumerate(springs):
        K[k : k + 2, k : k + 2] += spring * np.array([[1.0, -1.0], [-1.0, 1.0]])
    size = n + drift
    A = np.zeros((2 * size, 2 * size))
    A[:size, size:] = np.eye(size)
    A[size : size + n, :n] = -K / np.asarray(masses)[:, None]
    # the drifting masses are carried along by the chain, as a base by what hangs on it
    A[size + n :, :n] = 0.3 * K[0] / masses[0]
    squares, shapes = scipy.linalg.eigh(K, np.diag(masses))
    return A, np.sqrt(np.maximum(squares, 0.0)), shapes


def all_shares(linear, mode):
    """Shares (n,) of a mode: `Mode.states` names three, so the states are asked for in turns."""
    shares = dict(mode.states)
    return np.array([shares.get(name, np.nan) for name, _ in linear.states])


def derivative_shares(A, s):
    """Shares by central differences of the eigenvalue next to s by each number on the diagonal."""
    found = []
    for j in range(len(A)):
        slopes = []
        for h in (1e-3 * max(abs(s), 1.0), 5e-4 * max(abs(s), 1.0)):
            ends = []
            for sign in (1.0, -1.0):
                changed = A.copy()
                changed[j, j] += sign * h
                values = np.linalg.eigvals(changed)
                ends.append(values[np.argmin(np.abs(values - s))])
            slopes.append((ends[0] - ends[1]) / (2 * h))
        found.append(abs((4 * slopes[1] - slopes[0]) / 3))
    return np.array(found) / np.sum(found)


def test_shares_of_a_free_chain_are_those_of_its_natural_modes():
    """Share of x_j is m_j phi_j^2 / 2 with phi^T M phi = 1, beside eight eigenvalues at zero."""
    masses, springs = [1.0, 2.5, 0.4, 1.7], [300.0, 40.0, 900.0]
    A, frequencies, shapes = free_chain(masses, springs)
    linear, checked = linear_of(A), 0
    for mode in linear.modes():
        if abs(mode.eigenvalue) < 1e-3:
            assert mode.states == ()
            assert "cluster" in mode.refusal
            continue
        k = int(np.argmin(np.abs(frequencies - abs(mode.eigenvalue))))
        exact = np.zeros(len(A))
        exact[:4] = exact[7:11] = np.asarray(masses) * shapes[:, k] ** 2 / 2
        found = all_shares(linear, mode)
        named = ~np.isnan(found)
        # round-off of 14 states
        np.testing.assert_allclose(found[named], exact[named], atol=1e-12)
        assert np.min(found[named]) >= np.sort(exact)[-3] - 1e-12
        assert mode.refusal == ""
        # an undamped oscillation neither doubles nor halves, whatever round-off its real part has
        assert mode.doubling_time == np.inf
        checked += 1
    assert checked == 6


@pytest.mark.parametrize("coupling", [0.0, 1e-14])
def test_shares_of_two_equal_pendulums_are_refused(coupling):
    """Any two combinations of their modes are modes too; a third pendulum keeps its shares."""
    A = np.zeros((6, 6))
    A[:3, 3:], A[3:, :3] = np.eye(3), -np.diag([4.0, 4.0, 9.0])
    A[3, 1] = A[4, 0] = coupling
    for mode in linear_of(A, "abcuvw").modes():
        if abs(abs(mode.eigenvalue) - 3.0) < 1e-9:
            assert {name for name, _ in mode.states[:2]} == {"c", "w"}
        else:
            assert mode.states == ()
            assert "shares are not determined: the eigenvalue is in a cluster" in mode.refusal


def test_a_multiple_eigenvalue_doubles_or_halves_in_its_time():
    """Critical damping, its unstable counterpart, and a double zero, which does neither."""
    for rate in (-5.0, 5.0):
        for mode in linear_of([[0.0, 1.0], [-(rate**2), 2 * rate]]).modes():
            assert mode.states == ()
            # the root of round-off, of a double eigenvalue
            assert mode.doubling_time == pytest.approx(np.log(2) / rate, rel=1e-6)
        # beside the zeros of a free body too
        A = np.zeros((4, 4))
        A[:2, :2], A[2, 3] = [[0.0, 1.0], [-(rate**2), 2 * rate]], 1.0
        times = sorted(
            mode.doubling_time for mode in linear_of(A).modes() if mode.doubling_time < np.inf
        )
        np.testing.assert_allclose(times, [np.log(2) / rate] * 2, rtol=1e-6)
    assert [mode.doubling_time for mode in linear_of([[0.0, 1.0], [0.0, 0.0]]).modes()] == [
        np.inf
    ] * 2


def test_a_stiff_machine_keeps_the_shares_of_its_slow_modes():
    """Frequencies 1e5 and 1 rad/s in one machine, weakly coupled."""
    A = np.zeros((4, 4))
    A[:2, 2:], A[2:, :2] = np.eye(2), [[-1e10, 1e7], [1e-3, -1.0]]
    modes = linear_of(A, "abuv").modes()
    assert [mode.refusal for mode in modes] == [""] * 4
    slow = min(modes, key=lambda mode: abs(mode.eigenvalue))
    assert {name for name, _ in slow.states[:2]} == {"b", "v"}


def test_tables_say_which_modes_they_leave_out():
    A, *_ = free_chain([1.0, 2.5], [300.0])
    modes = linear_of(A).modes()
    assert count_modes_at_zero(modes) == (
        "Not listed: 8 of 10 modes with |s| below 0.001 1/s, those of a free rigid body or slower ones."
    )
    assert count_modes_at_zero(modes[:0]) == ""
    equal = np.zeros((4, 4))
    equal[:2, 2:], equal[2:, :2] = np.eye(2), -4.0 * np.eye(2)
    console = Console(width=300, file=io.StringIO(), record=True)
    console.print(modes_table(linear_of(equal).modes()))
    assert "shares are not determined: the eigenvalue is in a cluster" in console.export_text()


def test_round_off_where_a_number_is_zero_changes_no_share():
    """A free base on which springs pull: its columns are zero, or what cancellation leaves of them."""
    rng, n = np.random.default_rng(3), 5
    for _ in range(20):
        spring = rng.normal(size=(n, n))
        exact = np.zeros((2 * n, 2 * n))
        exact[:n, n:] = np.eye(n)
        exact[n:, 2:n] = (-spring @ spring.T * 10 ** rng.uniform(1, 4))[:, 2:]
        rounded = exact.copy()
        rounded[n:, :2] = rng.normal(size=(n, 2)) * np.finfo(float).eps
        rounded[n:, :2] *= np.max(np.abs(exact[n:]), axis=1, keepdims=True)
        away = [mode for mode in linear_of(exact).modes() if abs(mode.eigenvalue) > 1e-3]
        assert len(away) == 2 * (n - 2)
        modes = linear_of(rounded).modes()
        for mode in away:
            nearest = min(modes, key=lambda one: abs(one.eigenvalue - mode.eigenvalue))
            assert nearest.refusal == mode.refusal == ""
            assert dict(nearest.states) == pytest.approx(dict(mode.states), abs=1e-9)


# --- random trees


def random_tree(rng, parents, floating):
    """Bodies on hinges and slides with springs and dampers, the first one free or on ground."""
    bodies, joints = [], []
    forces: list[Any] = [stm.Gravity([0.0, 0.0, -G])]
    place = np.zeros((len(parents), 3))
    for k, parent in enumerate(parents):
        place[k] = (place[parent] if parent >= 0 else 0.0) + rng.uniform(-0.4, 0.4, 3)
        moments = rng.uniform(0.01, 0.02, 3)
        free = floating and k == 0
        bodies.append(
            stm.Body(f"b{k}", rng.uniform(0.2, 2.0), np.diag(moments), position=place[k],
                     com=rng.uniform(-0.05, 0.05, 3), free=free)
        )  # fmt: skip
        if free:
            continue
        make = stm.translational if k % 3 == 2 else stm.revolute
        axis = rng.normal(size=3)
        joints.append(
            make(f"j{k}", "ground" if parent < 0 else f"b{parent}", f"b{k}",
                 point=place[k] + rng.uniform(-0.1, 0.1, 3), axis=axis / np.linalg.norm(axis))
        )  # fmt: skip
        forces.append(
            stm.mechanics.JointServo(f"j{k}", stiffness=rng.uniform(5.0, 200.0),
                                     damping=rng.uniform(0.05, 0.5), target=0.0)
        )  # fmt: skip
    return stm.System(bodies, joints, forces)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parents", "floating"), [((-1, 0, 1, 1, 0), True), ((-1, 0, 0, 2), False)]
)
def test_shares_of_random_trees_are_derivatives_of_their_eigenvalues(parents, floating):
    """Four sets of numbers a structure, a free base with rigid-body modes among them."""
    rng, space = np.random.default_rng(len(parents) + 10 * floating), None
    for _ in range(4):
        system = random_tree(rng, parents, floating)
        space = stm.TreeSpace(system) if space is None else space.with_system(system)
        linear = stm.linearize(space, space.from_state(system.reference))
        modes = linear.modes()
        away = [mode for mode in modes if abs(mode.eigenvalue) > 1e-3]
        assert len(away) == 2 * len(system.joints)
        for mode in away:
            assert mode.refusal == ""
            exact = derivative_shares(linear.A, mode.eigenvalue)
            found = all_shares(linear, mode)
            named = ~np.isnan(found)
            np.testing.assert_allclose(
                found[named], exact[named], rtol=DIFFERENCES, atol=1e-3 * DIFFERENCES
            )
            assert np.min(found[named]) >= np.sort(exact)[-3] - DIFFERENCES
