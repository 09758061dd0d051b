"""Record of an integration's accepted steps for the reverse pass: windows, and pieces of windows.

A window is a number of step attempts whose steps are recorded with their slopes, all in the same
memory; of an earlier window its start and the times of its steps stay. Where the windows of all
output times together would need too much memory, a piece is a number of windows that share the same
memory in turn, and of an earlier piece its start alone stays.
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .problem import Counts, IntegrationState, Problem, SegmentEnd, landing

MORE = diffrax.RESULTS.max_steps_reached

# An integration to one output time has as many windows as the steps that it may take at most, as long
# as the windows of all output times record no more than `ROOM` numbers; otherwise it has pieces, of
# at least `WINDOWS` windows each.
WINDOWS, ROOM = 256, 10_000_000


class RecordRoom(NamedTuple):
    """Room for the record of an integration to one output time.

    Attributes:
        steps: step attempts of a window.
        windows: windows of a piece. pieces: largest number of pieces.
    """

    steps: int
    windows: int
    pieces: int

    @classmethod
    def of(cls, steps: int, max_steps: int, segments: int, numbers: int) -> "RecordRoom":
        """Room for all of max_steps attempts, in each of the segments, of a state of so many numbers."""
        needed = -(-max_steps // steps)
        windows = max(WINDOWS, ROOM // (segments * (steps + numbers)))
        if needed <= windows:
            return cls(steps, needed, 1)
        # one window less: an earlier piece, integrated again, ends by a step cut short
        return cls(steps, windows, -(-needed // (windows - 1)))


class Steps(NamedTuple):
    """Record of accepted steps from ts[i], ys[i] to ts[i + 1], the first `taken` of n rows."""

    taken: Int[Array, ""]
    ts: Float[Array, " n+1"]
    ys: Float[Array, "n k"]
    slopes: Float[Array, "n s k"]
    end: Float[Array, " k"]


class Windows(NamedTuple):
    """Record of a piece of an integration in windows of at most n step attempts each.

    Attributes:
        number: number of windows.
        starts: y at the start of each window (w, k).
        taken: number of accepted steps of each window (w,).
        ts: times of these steps (w, n + 1) [s].
        last: steps of the last window.
    """

    number: Int[Array, ""]
    starts: Float[Array, "w k"]
    taken: Int[Array, " w"]
    ts: Float[Array, "w n+1"]
    last: Steps


class Now(NamedTuple):
    """Integration at the start of a window."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    solver_state: Any
    controller_state: Any


class RecordedPieces(NamedTuple):
    """Record of an integration: number of pieces, their starts (if there may be many), the last one."""

    number: Int[Array, ""]
    starts: Now | None
    last: Windows


def _empty(tree: Any, *rows: int) -> Any:
    """Zeros of the shapes of a pytree, this many rows of each."""
    return jax.tree.map(lambda x: jnp.zeros((*rows, *x.shape), x.dtype), tree)


def _end(now: Now, counts: tuple[Array, Array], result: diffrax.RESULTS) -> SegmentEnd:
    return SegmentEnd(now.t, now.y, now.solver_state, now.controller_state, *counts, result)


def in_pieces(
    problem: Problem, begin: Now, t1: Float[Array, ""], room: RecordRoom
) -> tuple[SegmentEnd, RecordedPieces]:
    """Integrate to t1 [s] piece by piece, each one window shorter than there is room for."""
    most, none = room.windows - 1, jnp.zeros((), int)
    run = lambda now: piece_of(problem, now, t1, room, most)
    _, windows = eqx.filter_eval_shape(run, begin)

    def unfinished(at: tuple[Any, ...]) -> Any:
        number, _, _, result, *_ = at
        return (number == 0) | ((result == MORE) & (number < room.pieces))

    def piece(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, now, starts, _, (accepted, rejected), _ = at
        end, windows = run(now)
        starts = jax.tree.map(lambda rows, x: rows.at[number].set(x), starts, now)
        counts = (accepted + end.accepted, rejected + end.rejected)
        now = Now(end.t, end.y, end.solver_state, end.controller_state)
        return number + 1, now, starts, end.result, counts, windows

    fine = diffrax.RESULTS.successful
    state = (none, begin, _empty(begin, room.pieces), fine, (none, none), _empty(windows))
    number, now, starts, result, counts, windows = jax.lax.while_loop(unfinished, piece, state)
    return _end(now, counts, result), RecordedPieces(number, starts, windows)


def piece_of(
    problem: Problem,
    begin: Now,
    t1: Float[Array, ""],
    room: RecordRoom,
    most: int,
    wanted: Bool[Array, ""] | bool = True,
) -> tuple[SegmentEnd, Windows]:
    """Integrate towards t1 [s] by at most so many windows, with a record, if it is wanted at all."""
    none = jnp.zeros((), int)
    _, steps = eqx.filter_eval_shape(_window, problem, begin, t1, room.steps)
    empty = _empty(steps)
    rows = _empty((begin.y, empty.taken, empty.ts), room.windows)

    def unfinished(at: tuple[Any, ...]) -> Any:
        number, _, _, result, *_ = at
        return wanted & ((number == 0) | ((result == MORE) & (number < most)))

    def window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, now, rows, _, counts, _ = at
        end, steps = _window(problem, now, t1, room.steps)
        new = (now.y, steps.taken, steps.ts)
        rows = jax.tree.map(lambda rows, x: rows.at[number].set(x), rows, new)
        counts = (counts[0] + end.accepted, counts[1] + end.rejected)
        now = Now(end.t, end.y, end.solver_state, end.controller_state)
        return number + 1, now, rows, end.result, counts, steps

    state = (none, begin, rows, diffrax.RESULTS.successful, (none, none), empty)
    number, now, rows, result, counts, last = jax.lax.while_loop(unfinished, window, state)
    starts, taken, ts = rows
    return _end(now, counts, result), Windows(number, starts, taken, ts, last)


def _window(
    problem: Problem, begin: Now, t1: Float[Array, ""], kept: int
) -> tuple[SegmentEnd, Steps]:
    """Take at most `kept` step attempts towards t1 [s], with a record of the accepted ones."""
    t, y, solver_state, controller_state = begin
    none, fine = jnp.zeros((), int), diffrax.RESULTS.successful
    step, counts = controller_state[0], Counts(none, none, none)
    carry = IntegrationState(t, y, step, solver_state, controller_state, counts, fine)
    solution = problem.solve(carry, t1, diffrax.ForwardMode(), max_steps=kept, dense=True)
    found: Any = solution.interpolation
    inner = found.infos["inner"]
    end = landing(solution)
    return end, Steps(end.accepted, found.ts, inner["y0"], inner["slopes"], end.y)


def again(problem: Problem, windows: Windows, number: Any) -> Steps:
    """Steps of a window before the last, computed again from its start."""
    # their lengths are known and none is rejected: no bounds are needed
    solver = dataclasses.replace(problem.solver(), far=None, guard=None)
    term, ts = diffrax.ODETerm(problem.field), windows.ts[number]
    memory = solver.init(term, ts[0], ts[1], windows.starts[number], problem.model)

    def step(at: tuple[Any, ...]) -> tuple[Any, ...]:
        i, y, ys, slopes = at
        end, _, info, *_ = solver.step(term, ts[i], ts[i + 1], y, problem.model, memory, False)
        return i + 1, end, ys.at[i].set(y), slopes.at[i].set(info["inner"]["slopes"])

    taken, last = windows.taken[number], windows.last
    rows = (jnp.zeros_like(last.ys), jnp.zeros_like(last.slopes))
    begin = (jnp.zeros((), int), windows.starts[number], *rows)
    _, end, ys, slopes = jax.lax.while_loop(lambda at: at[0] < taken, step, begin)
    return Steps(taken, ts, ys, slopes, end)
