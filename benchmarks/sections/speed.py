"""What a batch of trajectories costs, and how time grows with closed loops."""

from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from peers.adapter import Peer
from problems.compared import chain, disturbed, tracker
from sections.precision import reason
from sections.size import Size
from shared.clock import compile_and_measure, compiled, measure
from shared.methods import trajectory, words

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import _get_derivative

# Large enough that the loop cannot drop the evaluation, too small to move the state.
NUDGE = 1e-15
# A peer's setting that takes longer than this for all its trajectories ends its list [s].
PATIENCE = 2.0
# Growing chains end where one size took longer than this [s].
LONGEST = 90.0


def one_after_the_other(derivative: Any, count: int) -> Any:
    """x -> x after `count` evaluations, each of which needs the one before."""

    def run(x: Any) -> Any:
        return jax.lax.fori_loop(0, count, lambda _, x: x + NUDGE * derivative(x), x)

    return run


def errors(ends: Any, exact: Any) -> dict[str, float | None]:
    """Median and largest error over the trajectories that have a reference [m]."""
    count = min(len(ends), len(exact))
    off = np.linalg.norm(np.asarray(ends)[:count] - np.asarray(exact)[:count], axis=-1).max(-1)
    finite = bool(np.all(np.isfinite(off)))
    return {
        "median_error": float(np.median(off)) if finite else None,
        "largest_error": float(np.max(off)) if finite else None,
    }


class Batches:
    """Batches of one scene's trajectories from disturbed starts, tree and Dopri8.

    Attributes:
        exact: ends of the first trajectories, at a tight tolerance.
        tried: errors by tolerance. tolerance: the loosest whose largest error is small enough, else
            whose median is, else the last.
    """

    def __init__(self, size: Size) -> None:
        self.size, self.scene = size, tracker(size.horizons).scene
        self.ts = jnp.array([self.scene.t0, size.horizons[-1]])
        self.states = disturbed(self.scene, max(size.trajectories))
        count, self.tried = min(size.trajectories), []
        # Flights one by one are another program, whose rounding errors differ.
        program, _ = compiled(self.many(min(size.blocks)), *self.given(count, size.tight))
        ends, fine = program(*self.given(count, size.tight))
        if lost := int(np.sum(~np.asarray(fine))):
            raise RuntimeError(
                f"{lost} of {count} reference runs at {size.tight:g} stopped before the end."
            )
        self.exact = np.asarray(ends)
        for tolerance in size.batch_tolerances:
            ends, _ = program(*self.given(count, tolerance))
            self.tried.append({"tolerance": tolerance, **errors(ends, self.exact)})
        small = lambda error: error is not None and error <= size.batch_error
        fine = [row for row in self.tried if small(row["largest_error"])]
        fine += [row for row in self.tried if small(row["median_error"])]
        self.tolerance = (fine or self.tried[-1:])[0]["tolerance"]

    def given(self, count: int, tolerance: float) -> tuple[stm.State, Any, Any]:
        """Arguments of `many`: the first starts, the times and the tolerance."""
        return jax.tree.map(lambda x: x[:count], self.states), self.ts, jnp.asarray(tolerance)

    def many(self, block: int) -> Any:
        """(states, ts, tolerance) -> ends and success, vmap in blocks one after the other."""
        run = trajectory(stm.Tree(), diffrax.Dopri8())

        def one(state: Any, ts: Any, tolerance: Any) -> tuple[Any, Any]:
            path = run(self.scene.system, state, ts, tolerance)
            return path.states.r[-1], path.result == diffrax.RESULTS.successful

        def many(states: Any, ts: Any, tolerance: Any) -> tuple[Any, Any]:
            split = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), states)
            each = jax.vmap(one, in_axes=(0, None, None))
            ends, fine = jax.lax.map(lambda s: each(s, ts, tolerance), split)
            return ends.reshape(-1, *ends.shape[2:]), fine.reshape(-1)

        return many

    def row(self, count: int, block: int) -> dict[str, Any]:
        """Trajectories per second of one batch."""
        timing, (ends, fine), seconds = compile_and_measure(
            self.many(block), *self.given(count, self.tolerance), repeats=3, warm_up=0,
            budget=self.size.budget,
        )  # fmt: skip
        lost = int(np.sum(~np.asarray(fine)))
        row = {
            "method": "stmuav-jax, tree", "trajectories": count, "block": block,
            "tolerance": self.tolerance, "per_second": count / timing.median,
            "seconds": timing.to_dict(), "compile_seconds": seconds, "failed": lost,
            "failure": f"{lost} of {count} runs stopped before the end." if lost else "",
            **errors(ends, self.exact),
        }  # fmt: skip
        print(f"  {count} in blocks of {block}: {row['per_second']:.1f} per second", flush=True)
        return row


def throughput(
    peer: Peer, given: tuple[Any, Any, float], exact: Any, wanted: float, patience: float
) -> list[dict[str, Any]]:
    """A peer's trajectories per second, with finer settings until the error is small enough.

    Args:
        given: scene, consistent starts (k, n, .), end [s]. exact: positions at the end.
        patience: the list ends where all trajectories took longer than this [s].

    Returns:
        Rows; none for a peer without a mode for batches.
    """
    rows: list[dict[str, Any]] = []
    empty = {"method": peer.name, "per_second": None}
    for setting in peer.settings():
        try:
            done = peer.throughput(*given, setting)
        except Exception as error:
            return [*rows, empty | {"failure": reason(error)}]
        if done is None:
            return []
        rate, ends = done
        found, count = errors(ends, exact), len(ends)
        lost = int(np.sum(~np.isfinite(ends).all((1, 2))))
        said = f"{lost} of {count} trajectories ended with a state that is not finite."
        rows.append({
            **empty, "solver": setting.solver, "trajectories": count,
            "tolerance": setting.tolerance, "step": setting.step,
            "per_second": None if lost else rate, "not_finite": lost,
            "failure": said if lost else "", **found,
        })  # fmt: skip
        print(f"  {peer.name} {setting}: {rate:.1f} per second, {found}", flush=True)
        worst = found["largest_error"]
        if (worst is not None and worst <= wanted) or count / rate > patience:
            break
    return rows


def batch(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Trajectories per second: one, batches, and peers that offer a throughput mode."""
    runs = Batches(size)
    start = (runs.scene.system, runs.scene.state0, runs.ts, jnp.asarray(runs.tolerance))
    run = trajectory(stm.Tree(), diffrax.Dopri8())
    how = {"repeats": 5 * size.repeats, "budget": size.budget}
    single, _, _ = compile_and_measure(run, *start, **how)
    counts = sorted(size.trajectories)
    middle = counts[len(counts) // 2]
    rows = [runs.row(middle, block) for block in size.blocks if middle % block == 0]
    best = max(rows, key=lambda row: row["per_second"])["block"]
    rows += [runs.row(count, min(best, count)) for count in counts if count != middle]
    first, *_ = runs.given(min(size.peer_trajectories, max(counts)), runs.tolerance)
    said = "A batch of trajectories is not supported by our adapter."
    for peer in others:
        given = (runs.scene, first, size.horizons[-1])
        found = throughput(peer, given, runs.exact, size.batch_error, PATIENCE)
        rows += found or [{"method": peer.name, "per_second": None, "failure": said}]
    return {
        "what": "trajectories per second, uav_tracker case 2, disturbed starts",
        "horizon": float(runs.ts[-1]), "tolerance": runs.tolerance, "tried": runs.tried,
        "error_wanted": size.batch_error, "references": len(runs.exact), "rows": rows,
        "single": {"seconds": single.to_dict(), "per_second": 1 / single.best},
    }  # fmt: skip


def chain_cost(loops: int, size: Size) -> dict[str, Any]:
    """One acceleration of a chain of N loops, and of some chains one simulated second."""
    problem, tree, zero = chain(loops), stm.Tree(), jnp.zeros(())
    system, state = problem.scene.system, problem.scene.state0
    model = tree.prepare(system)
    field = lambda x: _get_derivative(tree, model, zero, x, stm.Unstabilised())[0]
    count = max(1, min(size.evaluations, 5000 // loops**2))
    how = {"repeats": size.repeats, "budget": size.budget}
    repeated, x = one_after_the_other(field, count), tree.to_vector(model, state)
    one, _, seconds = compile_and_measure(repeated, x, **how)
    row = {
        "loops": loops, "bodies": system.n_bodies, "acceleration_seconds": one.median / count,
        "acceleration_compile_seconds": seconds, "run_seconds": None, "failure": "",
    }  # fmt: skip
    if loops not in size.run_loops:
        return row
    given = (state, jnp.array([0.0, problem.horizons[-1]]), jnp.asarray(1e-6))
    # with known joints, the rows of planar loops that depend on others are left out
    run = partial(trajectory(tree, diffrax.Dopri8()), system)
    timing, path, seconds = compile_and_measure(run, *given, **how)
    fine = bool(path.result == diffrax.RESULTS.successful)
    return row | {
        "run_seconds": timing.to_dict(), "run_compile_seconds": seconds,
        "steps": int(path.counts.accepted[-1] + path.counts.rejected[-1]),
        "residual": float(path.worst.position[-1]), "failure": "" if fine else words(path.result),
    }  # fmt: skip


def exponent(rows: list[dict[str, Any]], least: int) -> float | None:
    """k of seconds of a run ~ N^k by least squares over rows with N >= least."""
    runs = {row["loops"]: row.get("run_seconds") for row in rows if not row["failure"]}
    good = np.log([(n, x["median"]) for n, x in runs.items() if n >= least and x])
    return float(np.polyfit(good[:, 0], good[:, 1], 1)[0]) if len(good) > 1 else None


def scaling(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Chains of N four-bar loops."""
    rows: list[dict[str, Any]] = []
    left = ""
    for loops in size.loops:
        if left:
            rows.append({"loops": loops, "failure": left})
            continue
        try:
            timing, row = measure(lambda n=loops: chain_cost(n, size), repeats=1, warm_up=0)
        except Exception as error:
            rows.append({"loops": loops, "failure": reason(error)})
            continue
        rows.append(row)
        run = f"{1e3 * row['run_seconds']['median']:.1f} ms" if row["run_seconds"] else "no run"
        run += f", all {timing.median:.0f} s {row['failure']}"
        print(f"  N = {loops}: {1e6 * row['acceleration_seconds']:.1f} us, {run}", flush=True)
        if timing.median > LONGEST:
            left = f"left out: N = {loops} took {timing.median:.0f} s"
    return {
        "what": "N-four-bar chain, tree without dependent rows; run: 1 s, Dopri8 at 1e-6", "rows": rows,
        "exponents": {"run": {"8": exponent(rows, 8)}},
    }  # fmt: skip
