"""What the parts of the failure benchmark share: sizes, schemes, the printed table's variant."""

from dataclasses import dataclass
from typing import Any

from failure_steps import Scheme
from failure_tables import Variant

MAIN_CASE = 2


DEFAULT, TIGHT = Scheme("ode45"), Scheme("ode45", 1e-6, 1e-9)
FIXED = tuple(Scheme(m, step=h) for m in ("rk4", "euler") for h in (1e-3, 2e-3))

ALL_MISPRINTS = Variant(
    lost_dots=True, transposed_gamma=True, transposed_jacobian=True, shared_index=True
)


@dataclass(frozen=True)
class Size:
    """How much is run."""

    cases: tuple[int, ...] = (1, 2, 3)
    t1: float = 2.0
    long: float = 10.0
    samples: int = 48
    collapses: int = 10
    eigenvalues_every: int = 20
    scenes: tuple[tuple[str, int], ...] = tuple(
        (name, case) for name in ("uav_tracker", "tracker") for case in (1, 2, 3)
    )
    span: float = 1.0


QUICK = Size((2,), 0.02, 0.02, 2, 1, 1000, (("uav_tracker", 2),), 0.02)


def say(row: dict[str, Any]) -> None:
    """One line of progress."""
    print(
        f"{row['part']} case {row['case']} {row['name']:32s} {row['scheme']:20s} "
        f"{row['reached']:.3f} s {row['steps']:6d} steps {row['failure']}",
        flush=True,
    )
