"""Names of the parts of a `Method`, and its defaults; loaded without JAX.

The command line, study files and their checks name solvers, formulations and stabilisations by
these words. The object behind a word is imported when it is built.
"""

from typing import Any, Literal

SolverName = Literal["dopri8", "tsit5", "kvaerno3", "kvaerno5", "auto"]
# Many runs at once are stepped by explicit methods alone.
ExplicitSolverName = Literal["dopri8", "tsit5"]
FormulationName = Literal["tree", "augmented"]
StabilisationName = Literal["projection", "baumgarte", "none"]

# Default of rtol and atol, on positions [m], Euler parameters, velocities [m/s], [rad/s] alike.
STEP_TOLERANCE = 1e-8
# Length of the first step that is tried [s].
FIRST_STEP = 1e-4
# Largest number of accepted and rejected steps between two output times.
STEPS_ALLOWED = 100_000


def solver_named(name: SolverName) -> Any:
    """Solver of this name; the text "auto" is returned as it is, for `simulate` to resolve."""
    import diffrax

    from .integration.stepping import kvaerno3, kvaerno5

    if name == "auto":
        return name
    return {
        "dopri8": diffrax.Dopri8,
        "tsit5": diffrax.Tsit5,
        "kvaerno3": kvaerno3,
        "kvaerno5": kvaerno5,
    }[name]()


def formulation_named(name: FormulationName) -> Any:
    """Formulation of this name."""
    from .formulations.augmented import Augmented
    from .tree.formulation import Tree

    return {"tree": Tree, "augmented": Augmented}[name]()


def stabilisation_named(name: StabilisationName) -> Any:
    """Stabilisation of this name, with its default gains or iterations."""
    from .formulations.stabilisation import Baumgarte, Projection, Unstabilised

    return {"projection": Projection, "baumgarte": Baumgarte, "none": Unstabilised}[name]()
