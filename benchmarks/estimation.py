"""Time per filter step on the report's case 2: one filter, online or not, a bank of 256, and the peers.

The 8-state model with corrected kinematics and Euler steps, the report's tuning
(alpha = 0.1, beta = 2, kappa = 0.1) in double precision, everything in one process on one core:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/estimation.py

FilterPy and dynamax run the same model on the same measurements where they are installed; the
largest difference of their states from ours is recorded beside the times. dynamax's hidden
jitter of 1e-9 is taken out, and its first entry is a measurement that is all prior: it updates
before it predicts.
"""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from shared.clock import Timing, measure, summary
from shared.record import benchmark

from stmuav_jax.estimation.filter import (
    DEFAULT,
    AbstractFilter,
    GaussianFilter,
    filter_bank,
    kalman_filter,
)
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.estimation.sigma import Unscented
from stmuav_jax.math.compiler import compiler_options
from stmuav_jax.uav.quadrotor.cases import thrusts
from stmuav_jax.uav.quadrotor.model import (
    PART_III,
    report_model,
    report_prior,
    state_rates,
)

DT = 1e-3
REPORT = Unscented(0.1, 2.0, 0.1)


@dataclass(frozen=True)
class Size:
    """How much is run: steps of a single filter, of the bank's, of FilterPy's; repeats."""

    steps: int = 2000
    bank_steps: int = 200
    peer_steps: int = 200
    filters: int = 256
    repeats: int = 9


QUICK = Size(steps=20, bank_steps=3, peer_steps=5, filters=8, repeats=1)


def record_of_case(case: int, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Thrusts (T, 4) and measured body rates (T, 3), truth by Euler steps as the filter's."""
    rng = np.random.default_rng(seed)
    u = np.asarray(thrusts(case, np.arange(count) * DT)).T
    noise = rng.normal(size=(count, 8)) * np.sqrt(PART_III.value("true.Q"))
    rate = state_rates()

    def step(q: Any, now: tuple) -> tuple:
        q = q + DT * rate(q, now[0]) + now[1]
        return q, q[3:6]

    start = jnp.asarray(PART_III.value("true.start"))
    seen = jax.jit(lambda s: jax.lax.scan(step, s, (u, noise))[1])(start)
    return u, np.asarray(seen) + rng.normal(size=(count, 3)) * np.sqrt(PART_III.value("true.R"))


def per_step(timing: Timing, steps: int) -> dict[str, float]:
    """Microseconds per filter step."""
    return {f"{k}_us": getattr(timing, k) / steps * 1e6 for k in ("median", "best", "spread")}


def ours(size: Size, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """One filter and the bank, in the forms that can be chosen."""
    methods = {
        "unscented_covariance": GaussianFilter(REPORT, "covariance"),
        "cubature_square_root": DEFAULT,
    }
    rng = np.random.default_rng(1)
    spread = 0.01 * rng.normal(size=(size.bank_steps, 3, size.filters))
    yb = jnp.asarray(y[: size.bank_steps, :, None] + spread)
    ys, us = jnp.asarray(y[: size.steps]), jnp.asarray(u[: size.steps])
    ub = jnp.asarray(u[: size.bank_steps])
    found: dict[str, Any] = {}
    for name, method in methods.items():
        single, bank = programs(method)
        timed = lambda call, *given: measure(lambda: call(*given), repeats=size.repeats)[0]
        found[name] = {
            "single": per_step(timed(single, ys, us), size.steps),
            "bank": per_step(timed(bank, yb, ub), size.bank_steps * size.filters),
        }
        print(name, found[name], flush=True)
    return found


def programs(method: AbstractFilter) -> tuple[Any, Any]:
    """Compiled functions of measurements and thrusts: a filter, and a bank.

    The filter returns all that it knows (means, roots, innovations), the bank means and NIS.
    """
    prior, model = report_prior(), report_model(propagation="euler")

    def single(y: Any, u: Any) -> Any:
        return kalman_filter(model, prior, y, u=u, dt=DT, method=method)

    def bank(y: Any, u: Any) -> Any:
        out = filter_bank(model, prior, y, u=u, dt=DT, method=method)
        return out.mean, out.nis, out.ok

    options = compiler_options()
    return jax.jit(single, compiler_options=options), jax.jit(bank, compiler_options=options)


def online(size: Size, u: np.ndarray, y: np.ndarray) -> dict[str, float]:
    """Microseconds of `OnlineFilter.step` with the default filter and 8 states, one call at a time."""
    found = OnlineFilter(report_model(propagation="euler"), report_prior())
    found.warm_up(u[0])
    seconds = []
    for k in range(size.steps):
        start = time.perf_counter()
        found.step(y[k], (k + 1) * DT, u[k])
        seconds.append(time.perf_counter() - start)
    return per_step(summary(seconds), 1)


def synchronous() -> None:
    """Keep every computation in the thread that asks for it; before JAX computes anything."""
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def with_online(size: Size, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """The online filter as it is, and in a process without asynchronous dispatch.

    XLA reads this option once, when its backend starts.
    """
    with ProcessPoolExecutor(1, get_context("spawn"), synchronous) as pool:
        apart = pool.submit(online, size, u, y).result()
    return {"default": online(size, u, y), "without_async_dispatch": apart}


def with_filterpy(size: Size, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """FilterPy, its functions in plain NumPy."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter  # pyright: ignore[reportMissingImports]

    J = np.asarray(PART_III.value("inertia"))
    J_inverse = np.linalg.inv(J)

    def step(q: np.ndarray, dt: float, u: np.ndarray) -> np.ndarray:
        (cp, ct), (sp, st) = np.cos(q[:2]), np.sin(q[:2])
        w, total = q[3:6], u.sum()
        yaw = (ct * w[2] - st * w[0]) / cp
        angles = [ct * w[0] + st * w[2], w[1] - sp * yaw, yaw]
        tau = [-q[7] * total + 0.5 * (u[1] - u[3]), q[6] * total + 0.5 * (u[2] - u[0]), 0.0]
        h = J @ w
        gyro = [w[1] * h[2] - w[2] * h[1], w[2] * h[0] - w[0] * h[2], w[0] * h[1] - w[1] * h[0]]
        turning = J_inverse @ np.array([t - g for t, g in zip(tau, gyro, strict=True)])
        return q + dt * np.array([*angles, *turning, 0.0, 0.0])

    def run() -> np.ndarray:
        points = MerweScaledSigmaPoints(8, 0.1, 2.0, 0.1)
        peer = UnscentedKalmanFilter(8, 3, DT, lambda q: q[3:6], step, points)
        peer.x = np.array(PART_III.value("filter.start"))
        peer.P = np.diag(PART_III.value("filter.P0"))
        peer.Q, peer.R = np.diag(PART_III.value("filter.Q")), np.diag(PART_III.value("filter.R"))
        path = []
        for k in range(size.peer_steps):
            peer.predict(u=u[k])
            peer.update(y[k])
            path.append(peer.x.copy())
        return np.array(path)

    timing, path = measure(run, repeats=min(size.repeats, 5))
    return {**per_step(timing, size.peer_steps), "apart": _apart(size, u, y, path)}


def _apart(size: Size, u: np.ndarray, y: np.ndarray, path: np.ndarray) -> float:
    """Largest difference of a peer's states from ours over `peer_steps`."""
    count = size.peer_steps
    out = kalman_filter(
        report_model(propagation="euler"), report_prior(), y[:count], u=u[:count], dt=DT,
        method=GaussianFilter(REPORT, "covariance"),
    )  # fmt: skip
    return float(np.max(np.abs(np.asarray(out.mean) - path)))


def with_dynamax(size: Size, u: np.ndarray, y: np.ndarray) -> dict[str, Any]:
    """dynamax in a jit'd scan, alone and vmapped; its model is ours for one state."""
    import dynamax.nonlinear_gaussian_ssm.inference_ukf as ukf  # pyright: ignore[reportMissingImports]
    from dynamax.nonlinear_gaussian_ssm.models import ParamsNLGSSM  # pyright: ignore[reportMissingImports]

    plain = ukf.psd_solve
    ukf.psd_solve = lambda A, b: plain(A, b, diagonal_boost=0.0)
    rate = state_rates()
    # it updates first: with our first prediction as its prior, and inputs one later
    model, start = report_model(propagation="euler"), report_prior()
    first = GaussianFilter(REPORT).predict(model, start, jnp.asarray(u[0]), DT)
    Q, R = (jnp.diag(jnp.asarray(PART_III.value(f"filter.{name}"))) for name in "QR")
    parameters = ParamsNLGSSM(
        first.mean, first.covariance, lambda q, u: q + DT * rate(q, u), Q, lambda q, u: q[3:6], R
    )
    # its annotation says int for kappa
    settings = ukf.UKFHyperParams(0.1, 2, 0.1)  # pyright: ignore[reportArgumentType]

    def run(y: Any, u: Any) -> Any:
        out = ukf.unscented_kalman_filter(
            parameters, y, settings, u, output_fields=["filtered_means", "filtered_covariances"]
        )
        return out.filtered_means, out.filtered_covariances

    single, many = jax.jit(run), jax.jit(jax.vmap(lambda y, u: run(y, u)[0], in_axes=(0, None)))
    # it takes the inputs of entry t + 1 for the step from t to t + 1
    ys, us = jnp.asarray(y[: size.steps]), jnp.asarray(u[: size.steps])
    timing, out = measure(lambda: single(ys, us), repeats=size.repeats)
    found: dict[str, Any] = {
        "single": per_step(timing, size.steps),
        "apart": _apart(size, u, y, np.asarray(out[0])[: size.peer_steps]),
    }
    yb = jnp.asarray(np.broadcast_to(y[: size.bank_steps], (size.filters, size.bank_steps, 3)))
    banked, _ = measure(lambda: many(yb, us[: size.bank_steps]), repeats=min(size.repeats, 3))
    ukf.psd_solve = plain
    return found | {"bank": per_step(banked, size.bank_steps * size.filters)}


def record(size: Size) -> Iterator[dict[str, Any]]:
    """Our filters, and those of other programs that are installed."""
    u, y = record_of_case(2, size.steps)
    content: dict[str, Any] = {"ours": ours(size, u, y)}
    content["online"] = with_online(size, u, y)
    print("online", content["online"], flush=True)
    for name, peer in (("filterpy", with_filterpy), ("dynamax", with_dynamax)):
        try:
            content[name] = peer(size, u, y)
        except ImportError as missing:
            content[name] = {"skipped": str(missing)}
        print(name, content[name], flush=True)
    yield content


if __name__ == "__main__":
    benchmark("estimation", __doc__, record, (Size(), QUICK))
