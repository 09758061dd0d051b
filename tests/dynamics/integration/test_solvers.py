"""The wrapped solver: projected ends, nothing stale remembered, order and interpolation kept."""

import dataclasses
from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum, relative_error, swung

import stmuav_jax as stm
from stmuav_jax.dynamics.formulations.base import Residuals
from stmuav_jax.dynamics.integration.problem import prepare_problem
from stmuav_jax.dynamics.integration.stepping import (
    ProjectedSolver,
    ProjectionLimit,
    StepSizeMemory,
    error_norm,
)

SYSTEM = pendulum()
START = swung(SYSTEM, 1.2, 2.0)
END = 1.0
SOLVERS = {"Tsit5": diffrax.Tsit5(), "Kvaerno3": diffrax.Kvaerno3(), "Dopri8": diffrax.Dopri8()}


def method(solver, tolerance=1e-8):
    """Maximal coordinates, in which a pendulum has constraints to hold.

    ForwardMode: nothing is differentiated backwards here.
    """
    return stm.Method(
        formulation=stm.Augmented(),
        solver=SOLVERS[solver],
        rtol=tolerance,
        atol=tolerance,
        adjoint=diffrax.ForwardMode(),
        # the wrapped solver alone, without the bound of steps that goes to step control
        steps="state",
    )


TOLERANCES = {"Tsit5": 1e-11, "Kvaerno3": 1e-5, "Dopri8": 1e-13}


@cache
def program(solver):
    """Trajectory from a state by one solver, at its own tolerance."""
    ts, how = jnp.asarray([0.0, 0.4, END]), method(solver, TOLERANCES[solver])
    return jax.jit(lambda s: stm.integrate(SYSTEM, s, ts, how))


@cache
def reached(solver):
    return program(solver)(START)


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS)
def test_every_step_ends_on_the_constraints(solver):
    worst = reached(solver).worst
    assert reached(solver).result == diffrax.RESULTS.successful
    assert float(worst.position[-1]) < 1e-14
    assert float(worst.velocity[-1]) < 1e-13
    assert float(worst.norm[-1]) < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize(("solver", "error"), [("Tsit5", 1e-9), ("Kvaerno3", 1e-3)])
def test_projected_solvers_agree_with_dopri8(solver, error):
    assert relative_error(reached(solver).states, reached("Dopri8").states) < error


# --- single steps


TIMES = jnp.asarray([0.0, 0.15, 0.3])


@pytest.fixture(scope="module")
def two_steps():
    """Two coarse steps, and the second again from a fresh start at the first one's end."""
    how = dataclasses.replace(method("Tsit5"), balances=True)
    problem = prepare_problem(SYSTEM, how)
    x = how.formulation.to_vector(problem.model, START)
    y0 = jnp.concatenate([x, jnp.zeros(1)])
    solver, terms = problem.solver(), diffrax.ODETerm(problem.field)

    @jax.jit
    def walk(y0, times):
        a, b, c = times
        model, middle = problem.model, 0.5 * (a + b)
        state = solver.init(terms, a, b, y0, model)
        y1, _, info, state, _ = solver.step(terms, a, b, y0, model, state, jnp.asarray(False))
        y2, *_ = solver.step(terms, b, c, y1, model, state, jnp.asarray(False))
        fresh = solver.init(terms, b, c, y1, model)
        again, *_ = solver.step(terms, b, c, y1, model, fresh, jnp.asarray(False))
        between = solver.interpolation_cls(t0=a, t1=b, **info)
        seen = [between.evaluate(t) for t in (a, middle, b)]
        return y1, y2, again, seen, between.evaluate(middle, b), info["shift"]

    return y0, jax.tree.map(np.asarray, walk(y0, TIMES))


def test_nothing_stale_is_remembered(two_steps):
    """The projection moved the end, so the slope that the solver kept is not used."""
    _, (_, y2, again, _, _, shift) = two_steps
    assert np.max(np.abs(shift)) > 1e-8
    np.testing.assert_allclose(y2, again, rtol=0, atol=1e-13)


def test_interpolation_meets_the_projected_end(two_steps):
    y0, (y1, _, _, (start, middle, end), part, shift) = two_steps
    np.testing.assert_allclose(start, y0, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(end, y1)
    assert np.max(np.abs(end - y1 + shift)) > 1e-8
    np.testing.assert_allclose(part, end - middle, rtol=0, atol=1e-15)


# --- step size control


def test_quadratures_do_not_steer_the_steps_and_an_error_that_is_not_finite_is_never_small():
    """A step into a place without a field must be refused: NaN < 1 is false, 0 < 1 is true."""
    norm = error_norm(2)
    for bad in (np.nan, np.inf):
        assert not float(norm(jnp.asarray([bad, 1.0, 0.0]))) < 1e300
    assert float(norm(jnp.asarray([3.0, 4.0, 1e9]))) == pytest.approx(np.sqrt(12.5))
    assert float(norm(jnp.zeros(3))) == 0
    assert np.all(np.isfinite(jax.grad(norm)(jnp.zeros(3))))


def test_a_step_cut_short_by_an_output_time_is_remembered():
    """After 0.1 cut to 0.001, the next step is 0.1 again and not ten times 0.001."""
    inner = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    start = StepSizeMemory(inner, jnp.asarray(0.1))  # pyright: ignore[reportCallIssue]
    controller = start.wrap(1)
    y = jnp.ones(2)
    terms, func = diffrax.ODETerm(lambda t, y, args: -y), diffrax.Tsit5().func
    _, state = controller.init(terms, 0.0, 1.0, y, None, None, func, 5)
    assert float(state[0]) == pytest.approx(0.1)
    keep, t0, t1, _, state, _ = controller.adapt_step_size(
        jnp.asarray(0.0), jnp.asarray(0.001), y, y, None, 1e-9 * y, 5, state
    )
    assert bool(keep)
    assert float(t0) == 0.001
    assert float(t1 - t0) == pytest.approx(0.1)
    # a rejected step is never lengthened
    keep, t0, t1, _, state, _ = controller.adapt_step_size(t0, t1, y, y, None, 1e3 * y, 5, state)
    assert not bool(keep)
    assert float(t1 - t0) < 0.1


def test_a_step_that_the_projection_moves_far_is_not_kept():
    """Beyond t = 0.5 "projection" throws the state to 1e8: no such state is ever the last."""
    none = jnp.zeros(())
    residuals = Residuals(*(none,) * 5)

    def project(t, y, args):
        return jnp.where(t > 0.5, 1e8 + y, y), residuals

    far = ProjectionLimit(1e-8, 1e-8, 1)
    solver = ProjectedSolver(
        diffrax.Dopri8(), project, lambda t, y, args: residuals, lambda t, y, args: args, far
    )
    controller = StepSizeMemory(  # pyright: ignore[reportCallIssue]
        controller=diffrax.PIDController(rtol=1e-8, atol=1e-8, norm=error_norm(1)),
        step=jnp.asarray(0.01),
    )
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: -y),
        solver,
        0.0,
        1.0,
        None,
        jnp.ones(1),
        stepsize_controller=controller,
        max_steps=500,
        throw=False,
    )
    assert found.result == diffrax.RESULTS.dt_min_reached
    assert found.ts is not None
    assert found.ys is not None
    assert float(found.ts[-1]) == pytest.approx(0.5, abs=1e-9)
    assert float(found.ys[-1, 0]) == pytest.approx(np.exp(-0.5), rel=1e-7)


def test_a_start_that_is_not_finite_ends_at_once():
    """It was tried until `max_steps`, which took a batch of large mechanisms minutes."""
    found = program("Dopri8")(jax.tree.map(lambda x: x * jnp.nan, START))
    assert found.result == diffrax.RESULTS.dt_min_reached
    assert int(found.counts.rejected[-1]) == 1
    assert np.all(np.isnan(found.states.r))
