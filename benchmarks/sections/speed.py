"""What one acceleration costs, what a batch of trajectories costs, and how both grow."""

import re
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from peers.adapter import Peer
from problems.compared import Problem, chain, disturbed, tracker
from sections.ours import label
from sections.precision import distance, reason
from sections.size import Size
from shared.clock import compiled, measure
from shared.methods import trajectory, words

import stmuav_jax as stm

# Large enough that the loop cannot drop the evaluation, too small to move the state.
NUDGE = 1e-15
# A peer's setting that takes longer than this for all its trajectories ends its list [s].
PATIENCE = 2.0
NOT_ALONE = "Accelerations alone are not timed in our adapter."
# Growing chains end where one size took longer than this [s].
LONGEST = 90.0


def operations(lowered: Any) -> int:
    """StableHLO operations in a lowered program, each called function counted once."""
    return len(re.findall(r"= \"?(?:stablehlo|chlo)\.", lowered.as_text()))


def one_after_the_other(derivative: Any, count: int) -> Any:
    """x -> x after `count` evaluations, each of which needs the one before."""

    def run(x: Any) -> Any:
        return jax.lax.fori_loop(0, count, lambda _, x: x + NUDGE * derivative(x), x)

    return run


def formulation_cost(formulation: Any, scene: stm.Scene, size: Size) -> list[dict[str, Any]]:
    """Seconds for one acceleration of one state, and of states in batches."""
    model = formulation.prepare(scene.system)
    t = jnp.asarray(scene.t0, float)
    field = lambda x: formulation.derivative(model, t, x, stm.Unstabilised())[0]
    to_vector = jax.jit(lambda state: formulation.to_vector(model, state))
    single = to_vector(scene.state0)
    ops = operations(jax.jit(field).lower(single))
    rows = []
    dense = isinstance(formulation, stm.Augmented) and formulation.solve == "dense"
    for batch in (1,) if dense else (1, *size.batches):
        count = max(1, size.evaluations // batch)
        if batch == 1:
            x, derivative = single, field
        else:
            x = jax.vmap(to_vector)(disturbed(scene, batch))
            derivative = jax.vmap(field)
        program, seconds = compiled(one_after_the_other(derivative, count), x)
        timing, _ = measure(lambda p=program, x=x: p(x), repeats=size.repeats, budget=5.0)
        each, spread = (x / (count * batch) for x in (timing.median, timing.spread))
        rows.append({
            "method": f"stmuav-jax, {label(formulation)}", "batch": batch, "seconds": each,
            "spread": spread, "compile_seconds": seconds, "operations": ops, "failure": "",
        })  # fmt: skip
        print(f"  {rows[-1]['method']} x {batch}: {1e6 * rows[-1]['seconds']:.2f} us", flush=True)
    return rows


def acceleration(size: Size, others: list[Peer]) -> dict[str, Any]:
    """One evaluation of all accelerations, a lower bound of any explicit step."""
    scene = tracker(size.horizons).scene
    kinds = (stm.Tree(), stm.Augmented(), stm.Augmented(solve="dense"))
    rows = []
    for formulation in kinds[: size.methods]:
        rows += formulation_cost(formulation, scene, size)
    for peer in others:
        row: dict[str, Any] = {"method": peer.name, "batch": 1, "seconds": None, "failure": ""}
        try:
            why = peer.unsupported(scene)
            row["seconds"] = None if why else peer.acceleration_seconds(scene)
            row["failure"] = why or ("" if row["seconds"] is not None else NOT_ALONE)
        except Exception as error:
            row["failure"] = reason(error)
        rows.append(row)
        print(f"  {peer.name}: {row['seconds']} {row['failure']}", flush=True)
    return {"what": "seconds for one acceleration, uav_tracker case 2", "rows": rows}


def in_blocks(formulation: Any, solver: Any, scene: stm.Scene, block: int) -> Any:
    """(states, ts, tolerance) -> end positions and success, vmap in blocks, one after the other."""
    run = trajectory(formulation, solver)

    def one(state: Any, ts: Any, tolerance: Any) -> tuple[Any, Any]:
        path = run(scene.system, state, ts, tolerance)
        return path.states.r[-1], path.result == diffrax.RESULTS.successful

    def many(states: Any, ts: Any, tolerance: Any) -> tuple[Any, Any]:
        split = jax.tree.map(lambda x: x.reshape(-1, block, *x.shape[1:]), states)
        each = jax.vmap(one, in_axes=(0, None, None))
        ends, fine = jax.lax.map(lambda s: each(s, ts, tolerance), split)
        return ends.reshape(-1, *ends.shape[2:]), fine.reshape(-1)

    return many


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
    """Batches of one scene's trajectories from disturbed starts."""

    def __init__(self, size: Size) -> None:
        self.size, self.scene = size, tracker(size.horizons).scene
        self.ts = jnp.array([self.scene.t0, size.horizons[-1]])
        self.states = disturbed(self.scene, max(size.trajectories))
        self.formulation, self.solver = stm.Tree(), diffrax.Dopri8()
        self.exact = self._exact()

    def first(self, count: int) -> stm.State:
        """The first `count` starts."""
        return jax.tree.map(lambda x: x[:count], self.states)

    def program(self, count: int, block: int) -> tuple[Any, float]:
        """Compiled for so many trajectories in blocks, and the seconds for that."""
        many = in_blocks(self.formulation, self.solver, self.scene, block)
        return compiled(many, self.first(count), self.ts, jnp.asarray(1e-6))

    def _exact(self) -> np.ndarray:
        count = min(self.size.trajectories)
        program, _ = self.program(count, 1)
        ends, fine = program(self.first(count), self.ts, jnp.asarray(self.size.tight))
        if not bool(np.all(fine)):
            lost = int(np.sum(~np.asarray(fine)))
            raise RuntimeError(
                f"{lost} of {count} reference runs at {self.size.tight:g} stopped before the end."
            )
        self.tight_program = program
        return np.asarray(ends)

    def tolerance(self) -> tuple[float, list[dict[str, Any]]]:
        """The loosest whose largest error is small enough, else whose median is; and what was tried."""
        count, tried = len(self.exact), []
        for tolerance in self.size.batch_tolerances:
            ends, _ = self.tight_program(self.first(count), self.ts, jnp.asarray(tolerance))
            tried.append({"tolerance": tolerance, **errors(ends, self.exact)})
        for key in ("largest_error", "median_error"):
            for row in tried:
                if row[key] is not None and row[key] <= self.size.batch_error:
                    return row["tolerance"], tried
        return tried[-1]["tolerance"], tried

    def row(self, count: int, block: int, tolerance: float) -> dict[str, Any]:
        """Trajectories per second of one batch."""
        program, seconds = self.program(count, block)
        arguments = (self.first(count), self.ts, jnp.asarray(tolerance))
        timing, (ends, fine) = measure(
            lambda: program(*arguments), repeats=3, warm_up=0, budget=self.size.budget
        )
        lost = int(np.sum(~np.asarray(fine)))
        row = {
            "method": "stmuav-jax, tree", "trajectories": count, "block": block,
            "tolerance": tolerance, "per_second": count / timing.median,
            "seconds": timing.to_dict(), "compile_seconds": seconds, "failed": lost,
            "failure": f"{lost} of {count} runs stopped before the end." if lost else "",
            **errors(ends, self.exact),
        }  # fmt: skip
        print(f"  {count} in blocks of {block}: {row['per_second']:.1f} per second", flush=True)
        return row

    def of_peer(self, peer: Peer) -> list[dict[str, Any]]:
        """A peer's throughput, finer settings until the error is small enough."""
        count = min(self.size.peer_trajectories, len(self.states.r))
        given = (self.scene, self.first(count), float(self.ts[-1]))
        rows = throughput(peer, given, self.exact, self.size.batch_error, PATIENCE)
        said = "A batch of trajectories is not written in our adapter."
        return rows or [{"method": peer.name, "per_second": None, "failure": said}]


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
    offered = getattr(peer, "throughput", None)
    empty = {"method": peer.name, "per_second": None}
    for setting in peer.settings() if offered else ():
        try:
            rate, ends = offered(*given, setting)  # pyright: ignore[reportOptionalCall]
        except Exception as error:
            return [*rows, empty | {"failure": reason(error)}]
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
    tolerance, tried = runs.tolerance()
    arguments = (runs.scene.system, runs.scene.state0, runs.ts, jnp.asarray(tolerance))
    alone, _ = compiled(trajectory(runs.formulation, runs.solver), *arguments)
    single, _ = measure(lambda: alone(*arguments), repeats=5 * size.repeats, budget=size.budget)
    counts = sorted(size.trajectories)
    middle = counts[len(counts) // 2]
    rows = [runs.row(middle, block, tolerance) for block in size.blocks if middle % block == 0]
    best = max(rows, key=lambda row: row["per_second"])["block"]
    rows += [runs.row(count, min(best, count), tolerance) for count in counts if count != middle]
    for peer in others:
        rows += runs.of_peer(peer)
    return {
        "what": "trajectories per second, uav_tracker case 2, disturbed starts",
        "horizon": float(runs.ts[-1]),
        "tolerance": tolerance,
        "tried": tried,
        "error_wanted": size.batch_error,
        "references": len(runs.exact),
        "single": {"seconds": single.to_dict(), "per_second": 1 / single.best},
        "rows": rows,
    }


def chain_cost(loops: int, size: Size) -> dict[str, Any]:
    """One acceleration of a chain of N loops."""
    problem = chain(loops)
    system, state = problem.system_and_start()
    tree = stm.Tree(redundant=True)
    model = tree.prepare(system)
    x, t = tree.to_vector(model, state), jnp.zeros(())
    field = lambda x: tree.derivative(model, t, x, stm.Unstabilised())[0]
    count = max(1, min(size.evaluations, 5000 // loops**2))
    program, seconds = compiled(one_after_the_other(field, count), x)
    one, _ = measure(lambda: program(x), repeats=size.repeats, budget=size.budget)
    row = {
        "loops": loops,
        "bodies": system.n_bodies,
        "acceleration_seconds": one.median / count,
        "acceleration_compile_seconds": seconds,
        "run_seconds": None,
        "failure": "",
    }
    return row | (chain_run(problem, loops, size) if loops in size.run_loops else {})


def chain_run(problem: Problem, loops: int, size: Size) -> dict[str, Any]:
    """One simulated second of a chain of N loops."""
    ts, tolerance = jnp.array([0.0, problem.horizons[-1]]), jnp.asarray(1e-6)
    arguments = (*problem.system_and_start(), ts, tolerance)
    run = trajectory(stm.Tree(redundant=True), diffrax.Dopri8())
    program, seconds = compiled(run, *arguments)
    timing, path = measure(lambda: program(*arguments), repeats=size.repeats, budget=size.budget)
    fine = bool(path.result == diffrax.RESULTS.successful)
    # parallel cranks: by symmetry all of them turn alike
    heights = np.asarray(path.states.r[-1])[: loops + 1, 1:2]
    return {
        "run_seconds": timing.to_dict(),
        "run_compile_seconds": seconds,
        "steps": int(path.counts.accepted[-1] + path.counts.rejected[-1]),
        "residual": float(path.worst.position[-1]),
        "cranks_differ": distance(heights, heights[:1] + 0 * heights),
        "failure": "" if fine else words(path.result),
    }


def exponent(rows: list[dict[str, Any]], key: str, least: int) -> float | None:
    """k of seconds ~ N^k by least squares over rows with N >= least."""
    read = lambda row: row[key]["median"] if isinstance(row[key], dict) else row[key]
    good = [(row["loops"], read(row)) for row in rows if not row["failure"] and row[key]]
    good = [pair for pair in good if pair[0] >= least]
    if len(good) < 2:
        return None
    n, seconds = np.log(np.array(good)).T
    return float(np.polyfit(n, seconds, 1)[0])


def scaling(size: Size, others: list[Peer]) -> dict[str, Any]:
    """Chains of N four-bar loops."""
    del others
    rows: list[dict[str, Any]] = []
    for loops in size.loops:
        clock: list[dict[str, Any]] = []
        try:
            timing, _ = measure(
                lambda n=loops, out=clock: out.append(chain_cost(n, size)), repeats=1, warm_up=0
            )
        except Exception as error:
            rows.append({"loops": loops, "failure": reason(error)})
            continue
        rows += clock
        row = rows[-1]
        run = f"{1e3 * row['run_seconds']['median']:.1f} ms" if row["run_seconds"] else "no run"
        print(
            f"  N = {loops}: {1e6 * row['acceleration_seconds']:.1f} us, {run}, "
            f"all {timing.median:.0f} s {row['failure']}",
            flush=True,
        )
        if timing.median > LONGEST:
            left = [n for n in size.loops if n > loops]
            text = f"left out: N = {loops} took {timing.median:.0f} s"
            rows += [{"loops": n, "failure": text} for n in left]
            break
    keys = {"acceleration": "acceleration_seconds", "run": "run_seconds"}
    return {
        "what": "N-four-bar chain, tree with dependent rows; run: 1 s, Dopri8 at 1e-6",
        "rows": rows,
        "exponents": {
            name: {str(least): exponent(rows, key, least) for least in (1, 8)}
            for name, key in keys.items()
        },
    }
