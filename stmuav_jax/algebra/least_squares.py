"""Iterative minimisation of a loss, with progress, the best values so far, and restarts.

The methods are those of optimistix, through `optimistix.OptaxMinimiser` those of optax, and
`CorrectedLevenbergMarquardt`. This module adds what long searches need: every step can be observed, the
best values are kept, a loss that is not finite ends the search, and a search can be interrupted and resumed.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ..checks.errors import SettingError
from ..checks.reason import AbstractReason
from .compiler import quick_jit
from .corrected import CorrectedLevenbergMarquardt
from .derivative import value_and_jacobian

Method = optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | CorrectedLevenbergMarquardt
# Values, their loss, and whether the method has converged there.
_Seen = tuple[Any, Any, Any]


class SearchReason(AbstractReason):
    """Reason why a search has ended."""

    CONVERGED = 0
    STEPS = 1
    PATIENCE = 2
    NOT_FINITE = 3
    INTERRUPTED = 4
    LIMIT_PASSED = 5


@dataclass(frozen=True)
class Search:
    """State of a search: the best values so far and the history of the loss.

    Attributes:
        values: best values so far. loss: loss at these values.
        history: losses at the start and after every step. best: step of the best values.
        reason: reason for the end of the search if it stops at this step.
    """

    values: PyTree[Array]
    loss: float
    history: tuple[float, ...]
    best: int
    reason: SearchReason

    @property
    def steps(self) -> int:
        """Number of steps taken, including those before a restart."""
        return len(self.history) - 1

    def words(self) -> str:
        """Sentence that says how the search has ended."""
        at = f"the best loss is {self.loss:.6g}, at step {self.best}"
        return {
            SearchReason.CONVERGED: f"Converged after {self.steps} steps; {at}.",
            SearchReason.STEPS: f"Stopped after the {self.steps} steps allowed; {at}.",
            SearchReason.PATIENCE: f"Stopped at step {self.steps}, no better for long; {at}.",
            SearchReason.NOT_FINITE: (
                f"The loss is not finite at step {self.steps}; what came before is kept: {at}."
            ),
            SearchReason.INTERRUPTED: f"Interrupted after {self.steps} steps; {at}.",
            SearchReason.LIMIT_PASSED: (
                f"Ended after {self.steps} steps with a solution that passes a limit: it conflicts "
                f"with what else is wanted; {at}."
            ),
        }[self.reason]


@quick_jit
def value_and_columns(function: Callable[[Any], Any], values: Any) -> tuple[Any, Any]:
    """Value of a function and the columns of its Jacobian, one last axis more, in one pass.

    Every search and every other caller with a function of the same form shares one program.
    """
    flat, unravel = ravel_pytree(values)
    return value_and_jacobian(lambda x: function(unravel(x)), flat)


# Jitted, so that a second search for a function of the same form does not trace it again.
@quick_jit
def _called(function: Callable[[Any], Any], values: Any) -> Any:
    return function(values)


def evaluated(
    function: Callable[[Any], Any], values: Any, *, columns: bool = True
) -> tuple[Any, Any]:
    """Value of a function, and the columns of its Jacobian as of `value_and_columns`.

    A function that has a method `evaluated(values, columns=...)` is evaluated by it: one that is made of
    several programs, or gives its value by the program of its derivatives.

    Args:
        columns: false if these are not needed, and may be anything.
    """
    own = getattr(function, "evaluated", None)
    if own is not None:
        return own(values, columns=columns)
    if columns:
        return value_and_columns(function, values)
    return _called(function, values), None


def _with_columns(value: Any, columns: Any) -> Callable[[Any], Any]:
    """Function with this value and Jacobian at the one point where it is called."""

    @jax.custom_jvp
    def of(values: Any) -> Any:
        del values
        return value

    @of.defjvp
    def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        del primals
        along = ravel_pytree(tangents[0])[0]
        return value, jax.tree.map(lambda J: J @ along, columns)

    return of


class _Stepper(eqx.Module):
    """Optimisation method together with the function and the shape of its result.

    Methods that need the whole Jacobian evaluate the function at `y_eval` of their state only:
    they are given `seen`, its value and columns there, and no copy of the function is compiled
    with the method's own equations. `seen` is None for the other methods.
    """

    function: Callable[[Any], Any]
    method: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser
    shape: Any = eqx.field(static=True)

    @property
    def squares(self) -> bool:
        return isinstance(self.method, optx.AbstractGaussNewton)

    def of(self, seen: Any) -> Callable[[Any, Any], tuple[Any, None]]:
        function = self.function if seen is None else _with_columns(*seen)
        return lambda values, _: (function(values), None)

    def _initial(self, values: Any, seen: Any) -> Any:
        return self.method.init(self.of(seen), values, None, {}, self.shape, None, frozenset())

    def _read(self, state: Any) -> tuple[list[Any], Any]:
        """Arrays of a state of the method, and where such a method evaluates next."""
        return jax.tree.leaves(eqx.filter(state, eqx.is_array)), getattr(state, "y_eval", None)

    # The other leaves of a state are the same in every state. Some of them, such as traced
    # functions, no other process could read: a program that is kept makes them again.

    @quick_jit
    def begin(self, values: Any, seen: Any) -> tuple[list[Any], Any]:
        """Arrays of the initial state of the method, and where it evaluates first."""
        return self._read(self._initial(values, seen))

    @quick_jit
    def step(
        self, values: Any, arrays: list[Array], seen: Any
    ) -> tuple[Any, tuple[list[Any], Any], Any, Array, Array]:
        """Next values and state, the values of known loss, their loss, and the flag of the end."""
        own, rest = eqx.partition(self._initial(values, seen), eqx.is_array)
        state = eqx.combine(jax.tree.unflatten(jax.tree.structure(own), arrays), rest)
        of = self.of(seen)
        after, state, _ = self.method.step(of, values, None, {}, state, frozenset())
        done, _ = self.method.terminate(of, after, None, {}, state, frozenset())
        # a minimiser of optax knows the loss before its step, all other methods the loss after it
        behind = isinstance(self.method, optx.OptaxMinimiser)
        known, loss = (values, state.f) if behind else (after, state.f_info.as_min())
        return after, self._read(state), known, loss, done


def search(
    function: Callable[[Any], Any],
    start: PyTree[Any],
    method: Method,
    *,
    steps: int = 100,
    patience: int = 20,
    gain: float = 1e-3,
    report: Callable[[Search], None] | None = None,
    resume: Search | None = None,
) -> Search:
    """Minimise a loss, or the sum of squares of residuals, over the leaves of a pytree.

    Args:
        function: for a least-squares method such as `CorrectedLevenbergMarquardt()` or
            `optimistix.LevenbergMarquardt`, a function from values to residuals (any pytree); for a minimiser such as
            `optimistix.OptaxMinimiser(optax.adam(1e-2), rtol, atol)`, from values to a loss ().
        steps: largest number of steps in all.
        patience: number of steps without a relative gain of `gain` after which the search ends.
        report: progress callback at the start and after every step; a `KeyboardInterrupt` in it
            or in a step ends the search.
        resume: earlier search for the same function, continued from its best values.

    Raises:
        SettingError: steps or patience are not positive, the loss at the start is not finite, or
            `resume` has values of another form.
    """
    for name, count in (("steps", steps), ("patience", patience)):
        if count < 1:
            raise SettingError(f"A search needs at least one of {name}, not {count}.")
    values = jax.tree.map(lambda x: jnp.asarray(x, dtype=float), start)
    if resume is not None:
        _check_form(resume.values, values)
        values = resume.values
    if isinstance(method, CorrectedLevenbergMarquardt):
        going = _corrected(function, method, values)
    else:
        going = _stepped(function, method, values)
    return _go(going, resume, steps, patience, gain, report)


def _stepped(
    function: Callable[[Any], Any],
    method: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    values: Any,
) -> Iterator[_Seen]:
    """Steps of a method of optimistix; the first tells the loss at the start."""
    seen = None
    if isinstance(method, optx.AbstractGaussNewton):
        seen = evaluated(function, values)
        found = seen[0]
    else:
        found = eqx.filter_eval_shape(_called, function, values)
    shape = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), found)
    stepper = _Stepper(function, method, shape)
    arrays, place = stepper.begin(values, seen)
    while True:
        if seen is None and stepper.squares:
            seen = evaluated(function, place)
        values, (arrays, place), known, loss, done = stepper.step(values, arrays, seen)
        seen = None
        yield known, loss, done


def _corrected(
    function: Callable[[Any], Any], method: CorrectedLevenbergMarquardt, values: Any
) -> Iterator[_Seen]:
    """Steps of the corrected method; the first tells the loss at the start."""
    residuals: Callable[[Any], Any] = lambda values: evaluated(function, values, columns=False)[0]
    seen = evaluated(function, values)
    yield values, 0.5 * sum(np.sum(np.square(x)) for x in jax.tree.leaves(seen[0])), False
    damping = 1.0
    while True:
        step = method.attempt(residuals, values, seen, damping)
        values, damping = step.values, step.damping
        yield values, step.loss, step.done
        if step.taken:
            seen = evaluated(function, values)


def _go(
    going: Iterator[_Seen],
    now: Search | None,
    steps: int,
    patience: int,
    gain: float,
    report: Callable[[Search], None] | None,
) -> Search:
    begun = now is not None
    mark, mark_loss = (now.steps, now.loss) if now is not None else (0, np.inf)
    reason = SearchReason.STEPS
    try:
        while now is None or now.steps < steps:
            known, loss, done = next(going)
            if begun:
                # the first step of a resumed search only evaluates the loss where it starts
                begun = False
                continue
            now = _seen(now, known, float(loss))
            if now.reason is SearchReason.NOT_FINITE:
                return now
            if report is not None:
                report(now)
            if now.loss < (1 - gain) * mark_loss:
                mark, mark_loss = now.steps, now.loss
            if bool(done):
                reason = SearchReason.CONVERGED
                break
            if now.steps - mark >= patience:
                reason = SearchReason.PATIENCE
                break
    except KeyboardInterrupt:
        if now is None:
            raise
        reason = SearchReason.INTERRUPTED
    assert now is not None
    return Search(now.values, now.loss, now.history, now.best, reason)


def _seen(now: Search | None, values: Any, loss: float) -> Search:
    """Search after one more value of the loss."""
    if now is None:
        if not np.isfinite(loss):
            raise SettingError(
                f"The loss at the start of the search is {loss}: choose another start."
            )
        return Search(values, loss, (loss,), 0, SearchReason.STEPS)
    history = (*now.history, loss)
    if not np.isfinite(loss):
        return Search(now.values, now.loss, history, now.best, SearchReason.NOT_FINITE)
    if loss < now.loss:
        return Search(values, loss, history, len(history) - 1, SearchReason.STEPS)
    return Search(now.values, now.loss, history, now.best, SearchReason.STEPS)


def _check_form(found: Any, wanted: Any) -> None:
    shapes = lambda tree: jax.tree.map(jnp.shape, tree)
    if jax.tree.structure(found) != jax.tree.structure(wanted) or shapes(found) != shapes(wanted):
        raise SettingError(
            "The search to go on with has values of another form: "
            f"{shapes(found)}, where {shapes(wanted)} is wanted."
        )
