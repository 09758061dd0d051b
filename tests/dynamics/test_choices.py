"""Every word for a part of a `Method` builds one that a `Method` takes."""

from typing import get_args

import jax
import pytest

import stmuav_jax as stm
from stmuav_jax.dynamics.choices import (
    STEP_TOLERANCE,
    STEPS_ALLOWED,
    ExplicitSolverName,
    FormulationName,
    SolverName,
    StabilisationName,
    formulation_named,
    solver_named,
    stabilisation_named,
)


def test_every_solver_and_formulation_has_a_name():
    for name in get_args(SolverName):
        solver = stm.Method(solver=solver_named(name)).solver
        assert solver == "auto" if name == "auto" else type(solver).__name__.lower() == name
    texts = ("Tree(cut=chosen, redundant=False)", "Augmented(redundant=False)")
    for name, words in zip(get_args(FormulationName), texts, strict=True):
        assert str(stm.Method(formulation=formulation_named(name)).formulation) == words


def test_every_stabilisation_has_a_name():
    kinds = [type(stabilisation_named(name)) for name in get_args(StabilisationName)]
    assert kinds == [stm.Projection, stm.Baumgarte, stm.Unstabilised]


def test_defaults_are_those_of_a_method():
    method = stm.Method()
    assert (method.rtol, method.atol, method.max_steps) == (
        STEP_TOLERANCE,
        STEP_TOLERANCE,
        STEPS_ALLOWED,
    )
    assert set(get_args(ExplicitSolverName)) < set(get_args(SolverName))


def test_traced_tolerances_are_taken_as_they_are():
    """Values cannot be looked at under a transformation; outside of one they are."""
    assert jax.eval_shape(lambda rtol: stm.Method(rtol=rtol).rtol, 1e-30).shape == ()
    with pytest.raises(stm.SettingError, match="rtol must be finite and at least 1e-15"):
        stm.Method(rtol=1e-30)
