"""What breaks at half a second, and what does not: the report's method and its variants.

AFRL-AFOSR-JP-TR-2019-0058 reports that its simulation of the seven-body UAV stopped after 0.45
to 0.5 s and blames "high stiff" equations. This script runs the report's dense 83 x 83 system

    a  corrected, from a consistent start      d  with rows chosen once at the start
    b  with Table 4.1 of Part II as printed    e  in millimetres and by an inverse matrix
    c  from the Euler parameters as printed    f  without stabilisation for 10 s

The eigenvalues along the path, what was varied over geometries and how the printed table stops were
measured once; docs/failure.md says by which commit's scripts.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from dense.tables import Variant
from failing import measures
from failing.measures import Reference, Report, attempt, describe
from failing.steps import Scheme
from matplotlib.figure import Figure
from shared.command import begin, parser
from shared.pages import Row, panels, save
from shared.record import ROOT, environment, write

from stmuav_jax import Baumgarte, Method, Projection, Unstabilised, make_scene, simulate
from stmuav_jax.parameters import PRINTED_ORIENTATIONS

FIGURES = ROOT / "docs" / "figures" / "failure"
MAIN_CASE = 2

# e1 of p4 has the wrong sign in print; |p7| = 0.9974
SIGNED = {**PRINTED_ORIENTATIONS, "post_4": (0.9987, -0.0517, 0.0, 0.0)}
UNIT = {k: tuple(np.array(p) / np.linalg.norm(p)) for k, p in SIGNED.items()}

DEFAULT, TIGHT = Scheme("ode45"), Scheme("ode45", 1e-6, 1e-9)
FIXED = tuple(Scheme(m, step=h) for m in ("rk4", "euler") for h in (1e-3, 2e-3))
# schemes that are compared in the main case only
OTHERS = (
    Scheme("rk45"), Scheme("rk45", 1e-6, 1e-9), Scheme("radau"), Scheme("radau", 1e-5, 1e-8),
    Scheme("dop853", 1e-6, 1e-9),
)  # fmt: skip
ALL_MISPRINTS = Variant(
    lost_dots=True, transposed_gamma=True, transposed_jacobian=True, shared_index=True
)


@dataclass(frozen=True)
class Size:
    """How much is run: cases, ends of the runs [s], every which time with eigenvalues."""

    cases: tuple[int, ...] = (1, 2, 3)
    t1: float = 2.0
    long: float = 10.0
    eigenvalues_every: int = 20


QUICK = Size((2,), 0.02, 0.02, 1000)


@dataclass(frozen=True)
class Trial:
    """One line of the table: a part of the question, a name, what is done differently."""

    part: str
    name: str
    variant: Variant
    schemes: tuple[Scheme, ...] = (DEFAULT, TIGHT)
    p: Any = None


TRIALS = (
    Trial("a", "corrected", Variant(), (DEFAULT, TIGHT, *OTHERS, *FIXED)),
    Trial("b", "gamma: lost dots", Variant(lost_dots=True), (DEFAULT, TIGHT, FIXED[0])),
    Trial("b", "lost dots, d~^T in gamma", Variant(lost_dots=True, transposed_gamma=True)),
    Trial("b", "d~^T in the Jacobian", Variant(transposed_jacobian=True)),
    Trial("b", "h_j with the rate of body i", Variant(shared_index=True)),
    Trial("b", "all four", ALL_MISPRINTS, (DEFAULT, TIGHT, FIXED[0])),
    Trial("c", "printed p", Variant(), p=PRINTED_ORIENTATIONS),
    Trial("c", "printed p, sign of p4 restored", Variant(), p=SIGNED),
    Trial("c", "the same, normalised", Variant(), p=UNIT),
    Trial("d", "rows frozen at the start", Variant(frozen=True)),
    Trial("e", "millimetres, inverse matrix", Variant(metres=1e-3, inverse=True)),
    Trial("e", "metres, inverse matrix", Variant(inverse=True)),
)


@lru_cache(maxsize=1)
def references(size: Size) -> dict[int, Reference]:
    """The converged path of every case."""
    scenes = {case: make_scene("uav_tracker", case) for case in size.cases}
    return {case: measures.reference(scene, size.t1) for case, scene in scenes.items()}


def trials(size: Size) -> dict[str, Any]:
    """Parts a to e: every trial, case and scheme."""
    rows = []
    for case, ref in references(size).items():
        main = case == MAIN_CASE
        for trial in TRIALS:
            for scheme in (s for s in trial.schemes if main or s not in OTHERS):
                done = attempt(ref.scene, ref.times, scheme, trial.variant, trial.p)
                # eigenvalues by differences cost 200 evaluations each; series are for the figure
                record = describe(*done, ref, every=size.eigenvalues_every, series=main)
                row = {"part": trial.part, "name": trial.name, "case": case}
                rows.append({**row, "scheme": scheme.label, **record})
                print(*row.values(), scheme.label, done[1].summary(), flush=True)
    known = {
        case: {"t": ref.times.tolist(), "metres": ref.uncertainty.tolist()}
        for case, ref in references(size).items()
    }
    arithmetic = in_other_units(references(size)[MAIN_CASE])
    return {"reference_uncertainty": known, "arithmetic": arithmetic, "trials": rows}


def in_other_units(ref: Reference) -> list[dict[str, float]]:
    """Part e: accelerations in other units and by an inverse, against metres and `solve`."""
    rows = []
    for k in range(0, len(ref.times), max(1, len(ref.times) // 10)):
        t, base = float(ref.times[k]), Report(ref.scene)
        y = ref.start_at(base, k)
        right = base.accelerations(t, y)
        row = {"t": t, "condition_m": base.condition(t, y)}
        for name, metres, inverse in (
            ("m_inv", 1.0, True),
            ("mm", 1e-3, False),
            ("mm_inv", 1e-3, True),
        ):
            model = Report(ref.scene, Variant(metres=metres, inverse=inverse))
            y = ref.start_at(model, k)
            q = model.accelerations(t, y) * np.array([metres] * 3 + [1.0] * 4)
            row[f"error_{name}"] = float(np.max(np.abs(q - right)) / np.max(np.abs(right)))
            row["condition_mm"] = model.condition(t, y)
        rows.append(row)
    return rows


def long_run(size: Size) -> dict[str, Any]:
    """Part f: drift over a long time, case 2."""
    scene, times = make_scene("uav_tracker", MAIN_CASE), measures.grid(size.long)
    rows: list[dict[str, Any]] = []
    for scheme in (DEFAULT, TIGHT):
        record = describe(*attempt(scene, times, scheme), every=len(times))
        rows.append({"name": f"dense, {scheme.label}", **record})
    ways = (("none", Unstabilised()), ("Baumgarte", Baumgarte()), ("projection", Projection()))
    for name, how in ways:
        method = Method(rtol=1e-6, atol=1e-6, stabilisation=how)
        run = simulate(scene, method=method, t1=size.long, save_every=0.1, throw=False)
        rows.append({"name": f"package at 1e-6, {name}", **run.certificate.to_dict()})
    return {"long": rows}


def violation(result: Row) -> Figure:
    """Constraint violation against time of one run of each kind, case 2."""
    figure, (axes,) = panels(1, 1, 8, 4.2)
    kinds = ("corrected", "printed p", "gamma: lost dots", "d~^T in the Jacobian", "all four")
    tight = "ode45 1e-06/1e-09"
    axes.axvspan(0.45, 0.5, color="0.85", zorder=0, label="report's simulation stops")
    axes.grid(alpha=0.3)
    for name, scheme in (("corrected", "ode45 1e-03/1e-06"), *((kind, tight) for kind in kinds)):
        for row in result["trials"]:
            if (row["name"], row["scheme"], row["case"]) != (name, scheme, 2):
                continue
            series = row["series"]
            values = np.array(series["violation"], dtype=float)
            (line,) = axes.semilogy(series["t"][1:], values[1:], label=f"{name}, {scheme}")
            if row["failure"]:
                axes.plot(row["reached"], values[-1], "x", color=line.get_color(), ms=9, mew=2)
    axes.set(xlabel="t [s]", ylabel="largest constraint violation [m or 1]")
    axes.set_title("Case 2: constraint violation; a cross marks where a run stopped", fontsize=10)
    axes.legend(fontsize=8, loc="lower right")
    return figure


PARTS = {"trials": trials, "long": long_run}


def main() -> None:
    """Run parts and write `failure.json`, then the figure of a complete one."""
    again = "the figure from a complete result"
    made = parser(__doc__, quick="the smallest size, for a smoke test", redraw=again)
    made.add_argument("--figures", type=Path, default=FIGURES)
    made.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    options = made.parse_args()
    if not options.redraw:
        begin(options)
    path = options.results / "failure.json"
    for name in () if options.redraw else options.parts:
        found = PARTS[name](QUICK if options.quick else Size())
        # each part as soon as it is there, beside those of earlier runs
        old = json.loads(path.read_text()) if path.exists() else {}
        old.pop("environment", None)
        old["measured"] = {**old.get("measured", {}), name: environment()}
        what = {"what": "the report's dense system and its variants, Part II"}
        write("failure", {**what, **old, **found}, options.results)
    found = json.loads(path.read_text())
    if set(PARTS) <= set(found["measured"]):
        print(path, *save({"violation": violation(found)}, options.figures), sep="\n")


if __name__ == "__main__":
    main()
