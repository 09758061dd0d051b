"""What breaks at half a second, and what does not: the report's method and its variants.

AFRL-AFOSR-JP-TR-2019-0058 reports that its simulation of the seven-body UAV stopped after 0.45
to 0.5 s and blames "high stiff" equations. This script runs the report's dense 83 x 83 system

    a  corrected, from a consistent start      d  with rows chosen once at the start
    b  with Table 4.1 of Part II as printed    e  in millimetres and by an inverse matrix
    c  from the Euler parameters as printed    f  without stabilisation for 10 s

and measures (stiffness) the eigenvalues along the path and (g) when rod 5 lines up with the first
axis of its universal joint, for the adopted geometry and for others within its uncertainty.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from dense.tables import Variant
from failing.figures import draw
from failing.measures import (
    ALL_MISPRINTS,
    DEFAULT,
    FIXED,
    MAIN_CASE,
    QUICK,
    TIGHT,
    Reference,
    Size,
    attempt,
    describe,
    eigenvalues,
    grid,
    reduced_eigenvalues,
    reference,
    say,
)  # fmt: skip
from failing.model import Report
from failing.steps import Scheme
from failing.variations import alignment, alignment_methods, collapses, nature
from shared.command import begin, parser
from shared.record import ROOT, environment, write

from stmuav_jax import Baumgarte, Method, Projection, Unstabilised, make_scene, simulate
from stmuav_jax.parameters import PRINTED_ORIENTATIONS

FIGURES = ROOT / "docs" / "figures" / "failure"

# e1 of p4 has the wrong sign in print; |p7| = 0.9974
SIGNED = {**PRINTED_ORIENTATIONS, "post_4": (0.9987, -0.0517, 0.0, 0.0)}
UNIT = {k: tuple(np.array(p) / np.linalg.norm(p)) for k, p in SIGNED.items()}


@dataclass(frozen=True)
class Trial:
    """One line of the table: a part of the question, a name, what is done differently."""

    part: str
    name: str
    variant: Variant
    schemes: tuple[Scheme, ...] = (DEFAULT, TIGHT)
    p: Any = None

    @property
    def short(self) -> tuple[Scheme, ...]:
        """What the other cases get: without the comparison of adaptive methods."""
        others = ("rk45", "radau", "dop853")
        return tuple(scheme for scheme in self.schemes if scheme.method not in others)


EVERY_SCHEME = (
    DEFAULT, TIGHT, Scheme("rk45"), Scheme("rk45", 1e-6, 1e-9), Scheme("radau"),
    Scheme("radau", 1e-5, 1e-8), Scheme("dop853", 1e-6, 1e-9), *FIXED,
)  # fmt: skip
TRIALS = (
    Trial("a", "corrected", Variant(), EVERY_SCHEME),
    Trial("b", "gamma: lost dots", Variant(lost_dots=True), (DEFAULT, TIGHT, FIXED[0])),
    Trial("b", "lost dots, d~^T in gamma", Variant(lost_dots=True, transposed_gamma=True)),
    Trial("b", "d~^T in the Jacobian", Variant(transposed_jacobian=True)),
    Trial("b", "h_j with the rate of body i", Variant(shared_index=True)),
    Trial("b", "all four", ALL_MISPRINTS, (DEFAULT, TIGHT, FIXED[0])),
    Trial("c", "printed p", Variant(), (DEFAULT, TIGHT), PRINTED_ORIENTATIONS),
    Trial("c", "printed p, sign of p4 restored", Variant(), (DEFAULT, TIGHT), SIGNED),
    Trial("c", "the same, normalised", Variant(), (DEFAULT, TIGHT), UNIT),
    Trial("d", "rows frozen at the start", Variant(frozen=True)),
    Trial("e", "millimetres, inverse matrix", Variant(metres=1e-3, inverse=True)),
    Trial("e", "metres, inverse matrix", Variant(inverse=True)),
)


def trials(size: Size, refs: dict[int, Reference]) -> list[dict[str, Any]]:
    """Parts a to e: every trial, case and scheme."""
    rows = []
    for case, ref in refs.items():
        for trial in TRIALS:
            for scheme in trial.schemes if case == MAIN_CASE else trial.short:
                done = attempt(ref.scene, ref.times, scheme, trial.variant, trial.p)
                # eigenvalues by differences cost 200 evaluations each
                series = case == MAIN_CASE  # for the figure
                record = describe(*done, ref, every=size.eigenvalues_every, series=series)
                row = {"part": trial.part, "name": trial.name, "case": case}
                rows.append({**row, "scheme": scheme.label, **record})
                say(rows[-1])
    return rows


def arithmetic(ref: Reference) -> list[dict[str, float]]:
    """Part e: accelerations in other units and by an inverse, against metres and `solve`."""
    rows = []
    for k in range(0, len(ref.times), max(1, len(ref.times) // 10)):
        t, row = float(ref.times[k]), {"t": float(ref.times[k])}
        base = Report(ref.scene)
        y = _start_at(base, ref, k)
        right, row["condition_m"] = base.accelerations(t, y), base.condition(t, y)
        ways = (("m_inv", 1.0, True), ("mm", 1e-3, False), ("mm_inv", 1e-3, True))
        for name, metres, inverse in ways:
            model = Report(ref.scene, Variant(metres=metres, inverse=inverse))
            y = _start_at(model, ref, k)
            q = model.accelerations(t, y) * np.array([metres] * 3 + [1.0] * 4)
            row[f"error_{name}"] = float(np.max(np.abs(q - right)) / np.max(np.abs(right)))
            row["condition_mm"] = model.condition(t, y)
        rows.append(row)
    return rows


def long_run(size: Size) -> list[dict[str, Any]]:
    """Part f: drift over a long time, case 2."""
    scene = make_scene("uav_tracker", MAIN_CASE)
    times = grid(size.long)
    rows: list[dict[str, Any]] = []
    for scheme in (DEFAULT, TIGHT):
        model, history = attempt(scene, times, scheme)
        record = describe(model, history, every=len(times))
        rows.append({"name": f"dense, {scheme.label}", **record})
    ways = (("none", Unstabilised()), ("Baumgarte", Baumgarte()), ("projection", Projection()))
    for name, how in ways:
        method = Method(rtol=1e-6, atol=1e-6, stabilisation=how)
        run = simulate(scene, method=method, t1=size.long, save_every=0.1, throw=False)
        rows.append({"name": f"package at 1e-6, {name}", **run.certificate.to_dict()})
    return rows


def stiffness(size: Size, ref: Reference, scheme: Scheme = DEFAULT) -> dict[str, Any]:
    """Eigenvalues along the converged path, beside the steps that a run of `scheme` took.

    "dense": all 98 of the system as it is integrated; "reduced": 16, see `reduced_eigenvalues`.
    """
    times, model = np.asarray(ref.times), Report(ref.scene)
    pick = np.arange(0, len(times), min(2, size.eigenvalues_every))
    dense = np.array([eigenvalues(model, times[k], _start_at(model, ref, int(k))) for k in pick])
    reduced = reduced_eigenvalues(ref.scene, times, ref.states)[pick]
    _, history = attempt(ref.scene, times, scheme)
    times = times[pick]
    early, h = times <= 0.5, np.interp(times, history.ends, history.sizes)
    out: dict[str, Any] = {
        "case": ref.scene.name,
        "t": np.round(times, 6).tolist(),
        "steps": {"t": history.ends.tolist(), "h": history.sizes.tolist()},
    }
    for name, values in (("dense", dense), ("reduced", reduced)):
        fastest = np.max(np.abs(values), axis=1)
        out[name] = {
            "fastest": fastest.tolist(),
            "most_negative_real": np.min(np.real(values), axis=1).tolist(),
            "largest_real": np.max(np.real(values), axis=1).tolist(),
            "largest_imaginary": np.max(np.imag(values), axis=1).tolist(),
            "step_times_fastest": (h * fastest).tolist(),
            "before_half_second": {
                "fastest": float(np.max(fastest[early])),
                "most_negative_real": float(np.min(np.real(values)[early])),
                "largest_step_times_fastest": float(np.max((h * fastest)[early])),
            },
        }
    return out


def _start_at(model: Report, ref: Reference, k: int) -> np.ndarray:
    """The dense system's state at the k-th time of a reference."""
    state = jax.tree.map(lambda x: np.asarray(x)[k], ref.states)
    return model.begin(replace(ref.scene, state0=state))


def main() -> None:
    """Run parts and write `failure.json`, then the figures of a complete one."""
    made = parser(
        __doc__,
        quick="the smallest size, for a smoke test",
        redraw="figures from a complete result",
    )
    made.add_argument("--figures", type=Path, default=FIGURES)
    made.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    options = made.parse_args()
    if not options.redraw:
        begin(options)
    path = options.results / "failure.json"
    size = QUICK if options.quick else Size()
    for name in () if options.redraw else options.parts:
        found = PARTS[name](size)
        # each part as soon as it is there, beside those of earlier runs
        old = json.loads(path.read_text()) if path.exists() else {}
        old.pop("environment", None)
        old["measured"] = {**old.get("measured", {}), name: environment()}
        write("failure", {"what": WHAT, **old, **found}, options.results)
    if set(PARTS) <= set(json.loads(path.read_text())["measured"]):
        print(path, *draw(json.loads(path.read_text()), options.figures), sep="\n")


@lru_cache(maxsize=1)
def _references(size: Size) -> dict[int, Reference]:
    return {case: reference(make_scene("uav_tracker", case), size.t1) for case in size.cases}


def _trials(size: Size) -> dict[str, Any]:
    """Parts a to e."""
    refs = _references(size)
    return {
        "reference_uncertainty": {
            case: {"t": ref.times.tolist(), "metres": ref.uncertainty.tolist()}
            for case, ref in refs.items()
        },
        "arithmetic": arithmetic(refs[MAIN_CASE]),
        "trials": trials(size, refs),
    }


def _stiffness(size: Size) -> dict[str, Any]:
    return {"stiffness": [stiffness(size, ref) for ref in _references(size).values()]}


def _alignment(size: Size) -> dict[str, Any]:
    """Part g."""
    found = alignment(size)
    return {"alignment": found, "alignment_methods": alignment_methods(size, found)}


WHAT = "the report's dense system and its variants, Part II"
PARTS: dict[str, Callable[[Size], dict[str, Any]]] = {
    "trials": _trials,
    "stiffness": _stiffness,
    "alignment": _alignment,
    "nature": lambda size: {"nature": nature(size)},
    "long": lambda size: {"long": long_run(size)},
    "collapses": lambda size: {"collapses": collapses(size)},
}


if __name__ == "__main__":
    main()
