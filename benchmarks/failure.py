"""What breaks at half a second, and what does not: the runs of the report's method that decide it.

AFRL-AFOSR-JP-TR-2019-0058 reports that its simulation of the seven-body UAV stopped after 0.45
to 0.5 s and blames "high stiff" equations. This script runs the report's dense 83 x 83 system as
corrected, with Table 4.1 of Part II as printed, from the Euler parameters as printed, and with rows
chosen once. The whole investigation (more integrators,
eigenvalues along the path, other geometries, long times) was made once: docs/failure.md has its
results, which stay in `failure.json`; docs/validation.md names the commit of its scripts.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from dense.steps import Scheme
from dense.system import attempt
from dense.tables import Variant
from shared.record import RESULTS, benchmark, make_environment

from stmuav_jax import make_scene
from stmuav_jax.uav import PRINTED_ORIENTATIONS

MISPRINTS = Variant(
    lost_dots=True, transposed_gamma=True, transposed_jacobian=True, shared_index=True
)
# Name -> what is done differently, and Euler parameters in place of those of the start.
TRIALS: dict[str, tuple[Variant, Any]] = {
    "corrected": (Variant(), None),
    "gamma: lost dots": (Variant(lost_dots=True), None),
    "all four": (MISPRINTS, None),
    "printed p": (Variant(), PRINTED_ORIENTATIONS),
    "rows frozen at the start": (Variant(frozen=True), None),
}
SCHEMES = (Scheme("ode45"), Scheme("ode45", 1e-6, 1e-9), Scheme("rk4", step=1e-3))


@dataclass(frozen=True)
class Size:
    """How much is run: cases, end of the runs [s]."""

    cases: tuple[int, ...] = (1, 2, 3)
    t1: float = 2.0


def record(size: Size) -> Iterator[dict[str, Any]]:
    """How far every trial comes in every case by every scheme, beside the finished parts."""
    rows = []
    times = np.linspace(0.0, size.t1, round(100 * size.t1) + 1)
    for case in size.cases:
        scene = make_scene("uav_tracker", case)
        for name, (variant, p) in TRIALS.items():
            for scheme in SCHEMES:
                model, history = attempt(scene, times, scheme, variant, p)
                row = {"name": name, "case": case, "scheme": scheme.label, **history.summary()}
                row["violation"] = model.violation(history.states[-1])
                row["norm_error"] = model.norm_error(history.states[-1])
                rows.append(row)
                print(*row.values(), flush=True)
    path = RESULTS / "failure.json"
    former = json.loads(path.read_text()) if path.exists() else {}
    former.pop("environment", None)
    former["measured"] = {**former.get("measured", {}), "deciding": make_environment()}
    yield {
        **former,
        "what": "the report's dense system and its variants, Part II",
        "deciding": rows,
    }


if __name__ == "__main__":
    benchmark("failure", __doc__, record, (Size(), Size((2,), 0.02)))
