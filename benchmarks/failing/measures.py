"""Records of the runs: residuals, energy, norms, condition, eigenvalues, step count."""

from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from dense.tables import Variant
from failing.model import Report
from failing.steps import History, Limits, Scheme, integrate

from stmuav_jax import Augmented, Method, Scene, State, Unstabilised, simulate

Array = np.ndarray

EVERY = 0.01  # spacing of looked-at times [s]
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


def grid(t1: float) -> Array:
    """The times that are looked at, to t1 [s]."""
    return EVERY * np.arange(round(t1 / EVERY) + 1)


def say(row: dict[str, Any]) -> None:
    """One line of progress."""
    print(
        f"{row['part']} case {row['case']} {row['name']:32s} {row['scheme']:20s} "
        f"{row['reached']:.3f} s {row['steps']:6d} steps {row['failure']}",
        flush=True,
    )


@dataclass(frozen=True)
class Reference:
    """Converged positions (k, 7, 3) [m] at `times`, and how far two tolerances differ (k,)."""

    scene: Scene
    times: Array
    positions: Array
    uncertainty: Array
    states: State


def reference(scene: Scene, t1: float) -> Reference:
    """The scene by the package at 1e-11, with its difference from 1e-9."""
    times = grid(t1)
    fine, coarse = (
        simulate(scene, method=Method(rtol=tol, atol=tol), ts=times) for tol in (1e-11, 1e-9)
    )
    r = np.asarray(fine.states.r)
    apart = np.max(np.abs(r - np.asarray(coarse.states.r)), axis=(1, 2))
    return Reference(scene, times, r, apart, fine.states)


def attempt(
    scene: Scene,
    times: Array,
    scheme: Scheme,
    variant: Variant | None = None,
    p: dict[str, Any] | None = None,
    limits: Limits | None = None,
) -> tuple[Report, History]:
    """One run of the dense system."""
    model = Report(scene, variant)
    limits = limits or Limits()
    limits = replace(limits, size=limits.size / model.variant.metres)
    return model, integrate(model.derivative, model.begin(scene, p), times, scheme, limits)


def describe(
    model: Report,
    history: History,
    ref: Reference | None = None,
    every: int = 10,
    series: bool = False,
) -> dict[str, Any]:
    """The record of one run, numbers only; conditions and eigenvalues at every `every`-th time."""
    times, states = history.times, history.states
    violation = [model.violation(y) for y in states]
    energy = np.array([model.energy(y) for y in states])
    norm = [model.norm_error(y) for y in states]
    pick = range(0, len(times), every)
    condition = [model.condition(times[k], states[k]) for k in pick]
    values = np.concatenate([eigenvalues(model, times[k], states[k]) for k in pick])
    values = values[np.isfinite(values)]
    steps = history.sizes
    out: dict[str, Any] = {
        **history.summary(),
        "evaluations": history.evaluations,
        "seconds": history.seconds,
        "step_median": _of(np.median, steps),
        "step_smallest": _of(np.min, steps[:-1]),
        "violation": at_times(times, violation),
        "energy_drift": at_times(times, energy - energy[0]),
        "norm_error": at_times(times, norm),
        "condition": [float(np.min(condition)), float(np.max(condition))],
        "fastest_rate": _of(np.max, np.abs(values)),
        "most_negative_real": _of(np.min, np.real(values)),
        "largest_imaginary": _of(np.max, np.imag(values)),
    }
    if series:
        out["series"] = {
            "t": np.round(times, 6).tolist(),
            "violation": _short(violation),
            "energy_drift": _short(energy - energy[0]),
        }
    if ref is not None:
        count = len(times)
        apart = np.abs(model.positions(states) - ref.positions[:count])
        out["position_error"] = at_times(times, np.max(apart, axis=(1, 2)))
    return out


def at_times(times: Array, values: Any) -> dict[str, float | None]:
    """The values at a few fixed times, None where the run did not get there."""
    out: dict[str, float | None] = {}
    for t in (0.1, 0.35, 0.5, 1.0, 2.0):
        k = int(np.argmin(np.abs(times - t)))
        out[f"{t:g}"] = float(values[k]) if abs(times[k] - t) < 1e-9 else None
    return out


def _of(what: Any, values: Array) -> float | None:
    return float(what(values)) if values.size else None


def _short(values: Any) -> list[float | None]:
    return [float(f"{x:.3g}") if np.isfinite(x) else None for x in values]


def eigenvalues(model: Report, t: float, y: Array) -> Array:
    """Of dy'/dy of the dense system as it is integrated (98 values), by central differences."""
    size = y.size - 1
    jacobian = np.empty((size, size))
    for k in range(size):
        step = 1e-6 * max(1.0, abs(y[k]))
        up, down = y.copy(), y.copy()
        up[k] += step
        down[k] -= step
        change = model.derivative(t, up) - model.derivative(t, down)
        jacobian[:, k] = change[:-1] / (2 * step)
    if not np.all(np.isfinite(jacobian)):
        return np.full(size, np.nan + 0j)
    return np.linalg.eigvals(jacobian)


def _null(normals: jax.Array) -> jax.Array:
    """An orthonormal basis of what the rows leave free, as columns."""
    return jnp.linalg.svd(normals, full_matrices=True)[2][normals.shape[0] :].T


@eqx.filter_jit
def _reduced(system: Any, ts: Any, states: State) -> Any:
    formulation = Augmented()
    model = formulation.prepare(system)
    places = 7 * system.n_bodies

    def manifold(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        state = formulation.to_state(model, x)
        eq = model.constraints.equations(jnp.zeros(()), system.kinematics(state))
        u = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        return jnp.concatenate([eq.value, jnp.sum(state.p**2, axis=1) - 1]), eq.matrix @ u

    def one(at: Any) -> jax.Array:
        t, state = at
        x = formulation.to_vector(model, state)
        rate = lambda x: formulation.derivative(model, t, x, Unstabilised())[0]
        of_place, of_rate = jax.jacfwd(manifold)(x)
        tangent = _null(jnp.concatenate([of_place, of_rate]))
        bases = _null(of_place[:, :places]), _null(of_rate[:, places:])
        chart = jax.scipy.linalg.block_diag(bases[0].T, bases[1].T)
        return chart @ jax.jacfwd(rate)(x) @ tangent @ jnp.linalg.inv(chart @ tangent)

    return jax.lax.map(one, (ts, states))


def reduced_eigenvalues(scene: Scene, ts: Array, states: State) -> Array:
    """Eigenvalues (k, 16) of the equations reduced to the 8 degrees of freedom, along a path.

    Local coordinates at x0: z = T^T (q - q0) and w = B^T u, with T and B orthonormal bases of
    what the constraints leave free to q = (r, p) and to u = (v, omega'), SI units. Away from an
    equilibrium eigenvalues depend on such a choice; `eigenvalues` is another one.
    """
    at = jnp.asarray(ts), jax.tree.map(jnp.asarray, states)
    return np.linalg.eigvals(np.asarray(_reduced(scene.system, *at)))
