"""Every word for a part of a `Method` builds one that a `Method` takes; others are refused by name."""

from typing import get_args

import diffrax
import jax
import pytest

import stmuav_jax as stm
from stmuav_jax.dynamics.choices import (
    FormulationName,
    SolverName,
    StabilisationName,
    formulation_named,
    solver_named,
    stabilisation_named,
)


def test_every_solver_formulation_and_stabilisation_has_a_name():
    for name in get_args(SolverName):
        solver = stm.Method(solver=solver_named(name)).solver
        assert solver == "auto" if name == "auto" else type(solver).__name__.lower() == name
    texts = ("Tree(cut=chosen, redundant=False)", "Augmented(redundant=False)")
    for name, words in zip(get_args(FormulationName), texts, strict=True):
        assert str(stm.Method(formulation=formulation_named(name)).formulation) == words
    kinds = [type(stabilisation_named(name)) for name in get_args(StabilisationName)]
    assert kinds == [stm.Projection, stm.Baumgarte, stm.Unstabilised]


def test_traced_tolerances_are_taken_as_they_are():
    """Values cannot be looked at under a transformation; outside of one they are."""
    assert jax.eval_shape(lambda rtol: stm.Method(rtol=rtol).rtol, 1e-30).shape == ()
    with pytest.raises(stm.SettingError, match="rtol must be finite and at least 1e-15"):
        stm.Method(rtol=1e-30)


@pytest.mark.parametrize("adjoint", [diffrax.BacksolveAdjoint(), diffrax.ImplicitAdjoint()])
def test_adjoints_that_no_run_supports_are_refused_by_name(adjoint):
    with pytest.raises(stm.SettingError, match=rf"{type(adjoint).__name__}\(\): use the default"):
        stm.Method(adjoint=adjoint)
    for supported in (
        diffrax.ForwardMode(),
        diffrax.DirectAdjoint(),
        diffrax.RecursiveCheckpointAdjoint(),
    ):
        assert stm.Method(adjoint=supported).adjoint == supported
