"""Discrete adjoint of an explicit Runge-Kutta method: recorded steps, traversed in reverse.

With slopes k_i = f(t_i, y_i), y_i = y + h sum_j a_ij k_j of a step from y to y1 = y + h sum b_i k_i,
and l the derivative of a function of the result with respect to y1, the derivatives with respect
to the slopes follow from the last stage to the first,

    K_i = h (b_i l + sum_j a_ji L_j),    L_i = (df/dy)^T K_i,    derivative by y: l + sum_i L_i.

Accepted steps are recorded with their slopes, so only the right-hand sides are evaluated again,
for their derivatives, and rejected steps cost nothing. An integration of more step attempts than
can be recorded is divided into windows: the state at the start of each, the times of all steps and
the steps of the last window are recorded. In the reverse pass the steps of an earlier window are
computed again from its start at the recorded times, so that differences by round-off do not add
up. If the windows of all output times together would need too much memory, an integration is
divided into pieces of many windows each: of a piece before the last only the start is recorded, and
in the reverse pass it is integrated again to the start of the next. Step sizes are constants for
differentiation; derivatives with respect to the times of start and end are those of the flow.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), ch. VI.10.2
(adjoint equations of Runge-Kutta methods).
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nondifferentiable_backward
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import SettingError
from .explicit import NonDenseRungeKutta, coefficients
from .problem import Counts, IntegrationState, Problem, SegmentEnd, landing
from .record import (
    MORE,
    Now,
    RecordedPieces,
    RecordRoom,
    Steps,
    Windows,
    again,
    in_pieces,
    piece_of,
)

TWICE = (
    "Second derivatives of stmuav_jax.integrate by reverse mode over reverse mode are not available: "
    "take forward mode over reverse mode, jax.jacfwd(jax.grad(f)), or forward mode twice with "
    "Method(adjoint=diffrax.ForwardMode())."
)

# Step attempts recorded at a time, some hundred numbers each, divided among the output times. Setting
# their memory aside takes time: with 4,096 a gradient of a second of flight took two to three times as
# long, while of a longer flight the steps of all windows but the last are taken again.
KEPT = 1024
# Those of diffrax are states alone; where they are fewer than the steps, the path back may differ.
CHECKPOINTS = 4096


class DiscreteAdjoint(diffrax.AbstractAdjoint):
    """Discrete adjoint: reverse-mode derivatives of the accepted steps as they were taken.

    In `integrate` an explicit method without an event is differentiated as the module describes.
    With implicit methods, events, and in `diffrax.diffeqsolve` itself, the adjoint is diffrax's
    `RecursiveCheckpointAdjoint` with `recorded_steps` checkpoints, which takes adaptive steps again.

    Attributes:
        recorded_steps: number of step attempts recorded at a time; None for 1,024, or 4,096 checkpoints, divided
            among the output times, at least 64 for each.

    Raises:
        SettingError: `recorded_steps` is less than one.
    """

    recorded_steps: int | None = None

    def __check_init__(self) -> None:
        if self.recorded_steps is not None and self.recorded_steps < 1:
            raise SettingError(
                f"A DiscreteAdjoint keeps at least one step attempt, not {self.recorded_steps}."
            )

    def of(self, problem: Problem, segments: int) -> "diffrax.AbstractAdjoint | RecordRoom":
        """Adjoint for a problem with this number of output times, or the room for its record."""
        segments, most = max(segments, 1), problem.method.max_steps
        explicit = isinstance(problem.solver().solver, NonDenseRungeKutta)
        own = max((KEPT if explicit else CHECKPOINTS) // segments, 64)
        kept = min(most, own if self.recorded_steps is None else self.recorded_steps)
        if explicit:
            return RecordRoom.of(kept, most, segments, problem.n_state + problem.n_internal)
        return diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)

    def loop(self, **how: Any) -> Any:
        """Loop of `diffrax.diffeqsolve`, see there."""
        return diffrax.RecursiveCheckpointAdjoint(checkpoints=self.recorded_steps).loop(**how)


def recorded(
    problem: Problem, carry: IntegrationState, t1: Float[Array, ""], room: RecordRoom
) -> SegmentEnd:
    """Integrate to t1 [s] with the discrete adjoint, which has this room for its record."""
    bare = eqx.tree_at(lambda p: p.model, problem, None)
    start = _Start(problem.model, carry.y, carry.t, t1)
    memory = (carry.step, carry.solver_state, carry.controller_state)
    found = _recorded(start, _still(bare), _still(memory), room)
    y = found.y
    # the time reached depends on t1 only
    found, stop = _still(found._replace(y=None)), jax.lax.stop_gradient
    return found._replace(y=y, t=found.t + (t1 - stop(t1)))


def _still(tree: Any) -> Any:
    """Pytree with all arrays, also booleans with tangents in a loop, made constants."""
    still = lambda x: jax.lax.stop_gradient(x.astype(float)).astype(x.dtype)
    return jax.tree.map(lambda x: still(x) if eqx.is_array(x) else x, tree)


class _Start(NamedTuple):
    """Inputs with respect to which an integration is differentiated."""

    model: Any
    y: Float[Array, " k"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]


def _begun(start: _Start, problem: Problem, memory: Any) -> tuple[Problem, IntegrationState]:
    problem = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    none = jnp.zeros((), int)
    step, solver_state, controller_state = memory
    counts, fine = Counts(none, none, none), diffrax.RESULTS.successful
    carry = IntegrationState(start.t0, start.y, step, solver_state, controller_state, counts, fine)
    return problem, carry


@eqx.filter_custom_vjp
def _recorded(start: _Start, problem: Problem, memory: Any, room: RecordRoom) -> SegmentEnd:
    del room
    problem, carry = _begun(start, problem, memory)
    return landing(problem.solve(carry, start.t1, diffrax.ForwardMode()))


@_recorded.def_fwd
def _forward(
    perturbed: Any, start: _Start, problem: Problem, memory: Any, room: RecordRoom
) -> tuple[SegmentEnd, RecordedPieces]:
    """Integrate piece by piece, with a record of their starts and of the last one's windows."""
    del perturbed
    problem, carry = _begun(start, problem, memory)
    begin = Now(carry.t, carry.y, carry.solver_state, carry.controller_state)
    if room.pieces == 1:
        end, windows = piece_of(problem, begin, start.t1, room, room.windows)
        found = RecordedPieces(windows.number, None, windows)
    else:
        end, found = in_pieces(problem, begin, start.t1, room)
    over = end.accepted + end.rejected > problem.method.max_steps
    end = end._replace(result=diffrax.RESULTS.where(over, MORE, end.result))
    return end, found


@_recorded.def_bwd
def _backward(
    pieces: RecordedPieces,
    wanted: SegmentEnd,
    perturbed: Any,
    start: _Start,
    problem: Problem,
    memory: Any,
    room: RecordRoom,
) -> _Start:
    del memory
    # of all numbers of the model only those that depend on what is differentiated by
    arrays, rest = eqx.partition(start.model, perturbed.model)
    field = lambda t, y, args: problem.field(t, y, eqx.combine(args, rest))
    end = pieces.last.last.end
    last = jnp.zeros_like(end) if wanted.y is None else wanted.y
    last = jnp.where(jnp.isnan(end), jnp.nan, last)
    whole = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    # NaN also where there is no step to traverse
    none = jnp.where(jnp.any(jnp.isnan(last)), jnp.nan, 0.0)
    at_end = (last, jax.tree.map(lambda x: jnp.full_like(x, none), arrays))

    def back_piece(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        windows, fine = _piece_again(whole, pieces, number, room)
        by_end = jnp.where(fine, by_end, jnp.nan)
        return number - 1, *_through_windows(whole, windows, arrays, rest, (by_end, by_model))

    if pieces.starts is None:
        first, by_model = _through_windows(whole, pieces.last, arrays, rest, at_end)
    else:
        _, first, by_model = jax.lax.while_loop(
            lambda at: at[0] >= 0, back_piece, (pieces.number - 1, *at_end)
        )
    by_t0, by_t1 = None, None
    if perturbed.t0:
        by_t0 = -jnp.vdot(first, field(start.t0, start.y, arrays))
    if perturbed.t1:
        by_t1 = jnp.vdot(last, field(start.t1, end, arrays))
    none = jax.tree.map(lambda _: None, rest)
    found = _Start(eqx.combine(by_model, none), first, by_t0, by_t1)  # pyright: ignore
    return nondifferentiable_backward(found, msg=TWICE)


def _piece_again(
    problem: Problem, pieces: RecordedPieces, number: Int[Array, ""], room: RecordRoom
) -> tuple[Windows, Bool[Array, ""]]:
    """Windows of a piece, integrated again if it is not the last; False if they miss its end."""
    final = number == pieces.number - 1
    now, later = (jax.tree.map(lambda x, k=k: x[k], pieces.starts) for k in (number, number + 1))

    def integrated() -> tuple[Windows, Bool[Array, ""]]:
        # the condition is for batches, in which both branches are carried out
        end, windows = piece_of(problem, now, later.t, room, room.windows, ~final)
        return windows, end.result == diffrax.RESULTS.successful

    return jax.lax.cond(final, lambda: (pieces.last, jnp.array(True)), integrated)


def _through_windows(
    problem: Problem, windows: Windows, arrays: Any, rest: Any, at_end: tuple[Array, Any]
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of a piece and the model, from those of its end."""

    def back_window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        final = number == windows.number - 1
        steps = windows.last
        if len(windows.starts) > 1:
            steps = jax.lax.cond(final, lambda: steps, lambda: again(problem, windows, number))

        def back(at: tuple[Any, ...]) -> tuple[Any, ...]:
            i, by_end, by_model = at
            by_start, more = _step_back(problem, arrays, rest, steps, i, by_end)
            return i - 1, by_start, jax.tree.map(jnp.add, by_model, more)

        begin = (steps.taken - 1, by_end, by_model)
        _, by_start, by_model = jax.lax.while_loop(lambda at: at[0] >= 0, back, begin)
        return number - 1, by_start, by_model

    begin = (windows.number - 1, *at_end)
    return jax.lax.while_loop(lambda at: at[0] >= 0, back_window, begin)[1:]


def _step_back(
    problem: Problem, arrays: Any, rest: Any, steps: Steps, i: Int[Array, ""], by_end: Array
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of step i and the model, from those of its end."""
    solver = problem.solver()
    A, b, _, c = coefficients(solver.solver.method)  # pyright: ignore
    t, y, slopes = steps.ts[i], steps.ys[i], steps.slopes[i]
    t1 = steps.ts[i + 1]
    h = t1 - t
    by_model = jax.tree.map(jnp.zeros_like, arrays)
    # choices made at the start of the step have no derivative and are no parameters of the model
    numbers, others = eqx.partition(
        problem.at_step(t, y, eqx.combine(arrays, rest)), eqx.is_inexact_array
    )
    is_none = lambda x: x is None
    fixed = jax.tree.map(lambda x, a: a if x is None else None, arrays, numbers, is_leaf=is_none)
    rest = eqx.combine(fixed, others)
    if solver.project is not None:
        y1 = y + h * jnp.sum(b[:, None] * slopes, axis=0)
        project = lambda y, args: solver.project(t1, y, eqx.combine(args, rest))[0]  # pyright: ignore
        _, pull = jax.vjp(project, y1, arrays)
        by_end, by_model = pull(by_end)

    def stage(now: tuple[Any, Any], at: tuple[Any, ...]) -> tuple[Any, None]:
        by_slopes, by_model = now
        row, column, weight, share, number = at
        y_i = y + h * jnp.sum(row[:, None] * slopes, axis=0)
        field = lambda y, args: problem.field(t + share * h, y, eqx.combine(args, rest))
        _, pull = jax.vjp(field, y_i, arrays)
        by_y, more = pull(h * (weight * by_end + jnp.sum(column[:, None] * by_slopes, axis=0)))
        by_slopes = jax.lax.dynamic_update_index_in_dim(by_slopes, by_y, number, 0)
        return (by_slopes, jax.tree.map(jnp.add, by_model, more)), None

    table = (*(jnp.asarray(x) for x in (A, A.T, b, c)), jnp.arange(len(b)))
    begin = (jnp.zeros_like(slopes), by_model)
    (by_slopes, by_model), _ = jax.lax.scan(stage, begin, table, reverse=True)
    return by_end + jnp.sum(by_slopes, axis=0), by_model
