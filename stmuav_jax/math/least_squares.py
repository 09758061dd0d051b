"""Iterative minimisation of a loss, with progress, the best values so far, and restarts.

The methods are those of optimistix, through `optimistix.OptaxMinimiser` those of optax, and
`CorrectedLevenbergMarquardt`. This module adds what long searches need: every step can be observed, the
best values are kept, a loss that is not finite ends the search, and a search can be interrupted and resumed.

A Levenberg-Marquardt step solves min |r + J d|^2 + damping |d|^2. Where some residuals have large weights,
such as the defects of multiple shooting, their curvature spoils every step but the shortest. A correction
takes the remainder of the linear model at the end of the step,

    q = r(x + s) - (r + J d),    s <- s - (J^T J + damping 1)^-1 J^T q,

which costs one more value of the residuals and no Jacobian.

Source: J. Fan, The modified Levenberg-Marquardt method for nonlinear equations with cubic convergence,
Mathematics of Computation 81 (2012); J. Nocedal, S. J. Wright, Numerical Optimization (2006), ch. 10.3
(damping by the ratio of actual and predicted reduction) and ch. 15.5 (second-order corrections); D. M. Bates,
D. G. Watts, A relative offset orthogonality convergence criterion, Technometrics 23 (1981).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import scipy.linalg
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from ..checks.errors import AbstractReason, SettingError
from ..checks.numbers import as_jax
from .compiler import quick_jit
from .derivative import value_and_jacobian

# Smallest ratio of actual and predicted reduction with which a step is taken.
_TAKEN = 1e-2
# Ratios from which on the damping falls, and its factors; a step that is not taken takes back the largest
# fall. Where corrections follow the curvature a step can be long: with factors of 0.25 and 4 the slew of
# the UAV took 11 steps instead of 8, and holding it in segments of 0.05 s 9 instead of 6.
_FALLS, _MORE = ((0.95, 0.05), (0.75, 0.25)), 20.0
# A step that reaches this share of the predicted reduction needs no correction, and corrections end with
# one that adds less than this share of the reduction so far.
_ENOUGH, _LITTLE = 0.9, 0.01


class Attempt(NamedTuple):
    """Result of one step.

    Attributes:
        values: values after the step, or those before it if it is not taken. loss: half the sum of squares
            there. damping: that of the next step. is_accepted: the step is taken. is_last: it has converged.
    """

    values: Any
    loss: float
    damping: float
    is_accepted: bool
    is_last: bool


class CorrectedLevenbergMarquardt(eqx.Module):
    """Method of `search`: Levenberg-Marquardt steps with second-order corrections.

    A search has converged when a step changes the values by less than `atol + rtol |values|` and the loss,
    which is a square, by less than `atol^2 + rtol loss`; or when a step gains nothing where the linear model
    promises less than `rtol` of the loss in all, or where an undamped step would change the values by less than
    `atol + rtol |values|`.

    Attributes:
        rtol, atol: relative and absolute tolerances of the values.
        corrections: largest number of corrections of a step.
    """

    rtol: float = 1e-8
    atol: float = 1e-10
    corrections: int = eqx.field(static=True, default=10)

    def attempt(
        self, residuals: Callable[[Any], Any], values: Any, linearisation: Any, damping: float
    ) -> Attempt:
        """One step from values whose residuals and Jacobian have been seen.

        Everything but the residuals is computed by NumPy and LAPACK, for which nothing is compiled.

        Args:
            residuals: values -> residuals, any pytree. linearisation: residuals and columns of their Jacobian at
                the values, as `value_and_columns` gives them.
        """
        x, r, J = (
            _flatten_tree(values),
            _flatten_tree(linearisation[0]),
            _join_columns(linearisation[1]),
        )
        m, n = J.shape
        Q, R = np.linalg.qr(np.concatenate([J, np.sqrt(damping) * np.eye(n)]))
        towards = lambda q: scipy.linalg.solve_triangular(R, -(Q[:m].T @ q))
        step, before = towards(r), float(r @ r)
        linear = r + J @ step
        # The reduction is predicted by the linear model, so that the ratio below measures how far the model
        # holds, whatever the scale of the residuals.
        predicted = before - float(linear @ linear)
        best, squares = np.zeros(n), np.inf
        # Each correction repeats the linear solve with the residuals at the end of the step: a curved valley
        # is followed at the cost of residuals alone, while a new Jacobian costs as much as many of them.
        for k in range(1 + self.corrections):
            residual_vector = _flatten_tree(residuals(_unflatten_tree(values, x + step)))
            now, last = float(residual_vector @ residual_vector), squares
            if not now < last:
                break
            best, squares = step, now
            # A first step that the linear model predicts well needs no correction; a later one is worth its
            # residuals only if it still gains.
            enough = before - now >= _ENOUGH * predicted
            if enough if k == 0 else last - now <= _LITTLE * (before - now):
                break
            step = step + towards(residual_vector - linear)
        ratio = (before - squares) / predicted if predicted > 0 else -np.inf
        is_accepted = bool(ratio > _TAKEN)
        loss, after = 0.5 * before, 0.5 * squares
        # Both the values and the loss must have come to rest: on a flat valley the loss rests long before the
        # values, and on a kink the values before the loss.
        has_settled = bool(np.all(np.abs(best) <= self.atol + self.rtol * np.abs(x)))
        has_settled &= loss - after <= self.atol**2 + self.rtol * loss
        # Nothing is left to gain beyond round-off: of the loss, or of residuals of large weights, where a step
        # gains nothing though even an undamped one would gain next to nothing (Bates and Watts' relative offset,
        # over directions that change the residuals by more than round-off).
        flat = predicted <= 4 * np.finfo(float).eps * before
        if not (is_accepted or flat):
            U, sizes, Vt = scipy.linalg.svd(J, full_matrices=False)
            counts = sizes > max(m, n) * np.finfo(float).eps * np.max(sizes, initial=0.0)
            gradient_share = U[:, counts].T @ r
            flat = bool(gradient_share @ gradient_share <= self.rtol * before)
            # Residuals that can be zero are all round-off in the end: then no step gains what the model promises,
            # and the values are known as soon as the undamped step is within their tolerance.
            undamped = Vt[counts].T @ (gradient_share / sizes[counts])
            flat |= bool(np.all(np.abs(undamped) <= self.atol + self.rtol * np.abs(x)))
        return Attempt(
            values=_unflatten_tree(values, x + best) if is_accepted else values,
            loss=after if is_accepted else loss,
            damping=damping * (_damping_factor(ratio) if is_accepted else _MORE),
            is_accepted=is_accepted,
            is_last=(is_accepted and has_settled) or flat,
        )


def _damping_factor(ratio: float) -> float:
    """Factor of the damping after a step with this ratio of actual and predicted reduction."""
    return next((factor for least, factor in _FALLS if ratio > least), 1.0)


def _flatten_tree(tree: Any) -> Float[np.ndarray, " n"]:
    """All numbers of a pytree."""
    return np.concatenate([np.zeros(0), *(np.ravel(leaf) for leaf in jax.tree.leaves(tree))])


def _join_columns(columns: Any) -> Float[np.ndarray, "m n"]:
    """Jacobian from a pytree of its columns, which are the leaves' last axes."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(columns)]
    return np.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in leaves])


def _unflatten_tree(tree: Any, x: Float[np.ndarray, " n"]) -> Any:
    """Pytree of the same form with other numbers."""
    leaves, structure = jax.tree.flatten(tree)
    parts = np.split(x, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
    pairs = zip(parts, leaves, strict=True)
    return jax.tree.unflatten(structure, [as_jax(x.reshape(np.shape(leaf))) for x, leaf in pairs])


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

    def describe(self) -> str:
        """Sentence that says how the search has ended."""
        at = f"the best loss is {self.loss:.6g}, at step {self.best}"
        return {
            SearchReason.CONVERGED: f"Converged after {self.steps} steps; {at}.",
            SearchReason.STEPS: f"Stopped after the {self.steps} steps allowed; {at}.",
            SearchReason.PATIENCE: f"Stopped at step {self.steps}, no better for long; {at}.",
            SearchReason.NOT_FINITE: (
                f"The loss is not finite at step {self.steps}; the steps before are kept: {at}."
            ),
            SearchReason.INTERRUPTED: f"Interrupted after {self.steps} steps; {at}.",
            SearchReason.LIMIT_PASSED: (
                f"Ended after {self.steps} steps with a solution that violates a limit, which "
                f"conflicts with the other terms of the loss; {at}."
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
def _call_function(function: Callable[[Any], Any], values: Any) -> Any:
    return function(values)


def evaluate_columns(
    function: Callable[[Any], Any], values: Any, *, columns: bool = True
) -> tuple[Any, Any]:
    """Value of a function, and the columns of its Jacobian as of `value_and_columns`.

    A function that has a method `evaluated(values, columns=...)` is evaluated by it: one that is made of
    several programs, or gives its value by the program of its derivatives.

    Args:
        columns: false if these are not needed, and may be anything.
    """
    # Residuals that are themselves several compiled programs would be traced into one large program here,
    # which takes longer to compile than all of its parts.
    method = getattr(function, "evaluated", None)
    if method is not None:
        return method(values, columns=columns)
    if columns:
        return value_and_columns(function, values)
    return _call_function(function, values), None


def _with_columns(value: Any, columns: Any) -> Callable[[Any], Any]:
    """Function with this value and Jacobian at the one point where it is called."""

    @jax.custom_jvp
    def function_value(values: Any) -> Any:
        del values
        return value

    @function_value.defjvp
    def _(primals: tuple[Any], tangents: tuple[Any]) -> tuple[Any, Any]:
        del primals
        direction = ravel_pytree(tangents[0])[0]
        return value, jax.tree.map(lambda J: J @ direction, columns)

    return function_value


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

    def of(self, linearisation: Any) -> Callable[[Any, Any], tuple[Any, None]]:
        function = self.function if linearisation is None else _with_columns(*linearisation)
        return lambda values, _: (function(values), None)

    def _initial_state(self, values: Any, linearisation: Any) -> Any:
        return self.method.init(
            self.of(linearisation), values, None, {}, self.shape, None, frozenset()
        )

    def _read_state(self, state: Any) -> tuple[list[Any], Any]:
        """Arrays of a state of the method, and where such a method evaluates next."""
        return jax.tree.leaves(eqx.filter(state, eqx.is_array)), getattr(state, "y_eval", None)

    # The other leaves of a state are the same in every state. Some of them, such as traced
    # functions, no other process could read: a program that is kept makes them again.

    @quick_jit
    def begin(self, values: Any, linearisation: Any) -> tuple[list[Any], Any]:
        """Arrays of the initial state of the method, and where it evaluates first."""
        return self._read_state(self._initial_state(values, linearisation))

    @quick_jit
    def step(
        self, values: Any, arrays: list[Array], linearisation: Any
    ) -> tuple[Any, tuple[list[Any], Any], Any, Array, Array]:
        """Next values and state, the values of known loss, their loss, and the flag of the end."""
        initial_arrays, rest = eqx.partition(
            self._initial_state(values, linearisation), eqx.is_array
        )
        state = eqx.combine(jax.tree.unflatten(jax.tree.structure(initial_arrays), arrays), rest)
        of = self.of(linearisation)
        after, state, _ = self.method.step(of, values, None, {}, state, frozenset())
        has_converged, _ = self.method.terminate(of, after, None, {}, state, frozenset())
        # a minimiser of optax knows the loss before its step, all other methods the loss after it
        behind = isinstance(self.method, optx.OptaxMinimiser)
        loss_point, loss = (values, state.f) if behind else (after, state.f_info.as_min())
        return after, self._read_state(state), loss_point, loss, has_converged


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
        going = _iterate_corrected(function, method, values)
    else:
        going = _iterate_method(function, method, values)
    return _run_search(going, resume, steps, patience, gain, report)


def _iterate_method(
    function: Callable[[Any], Any],
    method: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser,
    values: Any,
) -> Iterator[_Seen]:
    """Steps of a method of optimistix; the first tells the loss at the start."""
    evaluation = None
    if isinstance(method, optx.AbstractGaussNewton):
        evaluation = evaluate_columns(function, values)
        residuals_there = evaluation[0]
    else:
        residuals_there = eqx.filter_eval_shape(_call_function, function, values)
    shape = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), residuals_there)
    stepper = _Stepper(function, method, shape)
    arrays, place = stepper.begin(values, evaluation)
    while True:
        if evaluation is None and stepper.squares:
            evaluation = evaluate_columns(function, place)
        values, (arrays, place), loss_point, loss, has_converged = stepper.step(
            values, arrays, evaluation
        )
        evaluation = None
        yield loss_point, loss, has_converged


def _iterate_corrected(
    function: Callable[[Any], Any], method: CorrectedLevenbergMarquardt, values: Any
) -> Iterator[_Seen]:
    """Steps of the corrected method; the first tells the loss at the start."""
    residuals: Callable[[Any], Any] = lambda values: evaluate_columns(
        function, values, columns=False
    )[0]
    evaluation = evaluate_columns(function, values)
    yield values, 0.5 * sum(np.sum(np.square(x)) for x in jax.tree.leaves(evaluation[0])), False
    # The residuals are scaled by the caller, so that a damping of one relative to the diagonal of J^T J
    # is a cautious first step in any problem.
    damping = 1.0
    while True:
        step = method.attempt(residuals, values, evaluation, damping)
        values, damping = step.values, step.damping
        yield values, step.loss, step.is_last
        if step.is_accepted:
            evaluation = evaluate_columns(function, values)


def _run_search(
    going: Iterator[_Seen],
    now: Search | None,
    steps: int,
    patience: int,
    gain: float,
    report: Callable[[Search], None] | None,
) -> Search:
    is_resumed = now is not None
    # Patience counts from the last step with a relative gain of at least `gain`: the many tiny gains at
    # the end of a valley would otherwise keep a search alive.
    mark, mark_loss = (now.steps, now.loss) if now is not None else (0, np.inf)
    reason = SearchReason.STEPS
    try:
        while now is None or now.steps < steps:
            loss_point, loss, has_converged = next(going)
            if is_resumed:
                # the first step of a resumed search only evaluates the loss where it starts
                is_resumed = False
                continue
            now = _update_search(now, loss_point, float(loss))
            if now.reason is SearchReason.NOT_FINITE:
                return now
            if report is not None:
                report(now)
            if now.loss < (1 - gain) * mark_loss:
                mark, mark_loss = now.steps, now.loss
            if bool(has_converged):
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


def _update_search(now: Search | None, values: Any, loss: float) -> Search:
    """Search after one more value of the loss."""
    if now is None:
        if not np.isfinite(loss):
            raise SettingError(
                f"The loss at the start of the search is {loss}: choose another start."
            )
        return Search(values, loss, (loss,), 0, SearchReason.STEPS)
    # The best values are kept apart from the latest ones, because a minimiser such as Adam does not
    # decrease the loss monotonically.
    history = (*now.history, loss)
    if not np.isfinite(loss):
        return Search(now.values, now.loss, history, now.best, SearchReason.NOT_FINITE)
    if loss < now.loss:
        return Search(values, loss, history, len(history) - 1, SearchReason.STEPS)
    return Search(now.values, now.loss, history, now.best, SearchReason.STEPS)


def _check_form(values: Any, expected_values: Any) -> None:
    shapes = lambda tree: jax.tree.map(jnp.shape, tree)
    if jax.tree.structure(values) != jax.tree.structure(expected_values) or shapes(
        values
    ) != shapes(expected_values):
        raise SettingError(
            "The search to resume has values of shapes "
            f"{shapes(values)}, but {shapes(expected_values)} are needed."
        )
