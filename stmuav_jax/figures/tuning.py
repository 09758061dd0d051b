"""Files and figures of parameter searches, tuned inputs and linear models."""

import io
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from pydantic import Field

from ..analysis.linear import Linear
from ..analysis.tuning import InputTuning, TunedMotion
from ..checks.errors import SettingError
from ..checks.schema import Entries, Tuples, format_value, quote_name, validate_model
from ..io.netcdf import FileError, load_checkpoint, save_checkpoint, write_atomically
from ..math.compiler import quick_jit
from ..math.least_squares import Search, SearchReason
from .plot import grid, look

_FORMAT = "stmuav_jax search 2"
_Loss = Annotated[float, Field(strict=True, allow_inf_nan=True)]


def save_linear(linear: Linear, path: str | os.PathLike[str]) -> Path:
    """Write A, B, C, D and the names with units of states, inputs and outputs to an npz file."""
    arrays: dict[str, Any] = {name: getattr(linear, name) for name in "ABCD"}
    for kind in ("states", "inputs", "outputs"):
        arrays[kind] = np.array([f"{name} [{unit}]" for name, unit in getattr(linear, kind)])
    content = io.BytesIO()
    np.savez(content, **arrays)
    return write_atomically(path, content.getvalue())


class _Head(Entries):
    """Everything of a search but its values; a loss may be NaN or infinite."""

    format: Literal["stmuav_jax search 2"]
    problem: str
    loss: _Loss
    history: Annotated[tuple[_Loss, ...], Tuples, Field(min_length=1)]
    best: Annotated[int, Field(ge=0)]
    reason: Annotated[int, Field(ge=min(SearchReason), le=max(SearchReason))]


def save_search(search: Search, problem: str, path: str | os.PathLike[str]) -> Path:
    """Write the state of a search, from which `load_search` resumes it.

    Args:
        search: state of the search.
        problem: name of the problem; searches of another problem are refused on loading.
        path: path of the npz file.
    """
    head = _Head(
        format=_FORMAT, problem=problem, loss=float(search.loss), best=int(search.best),
        history=tuple(map(float, search.history)), reason=int(search.reason),
    )  # fmt: skip
    return save_checkpoint(path, dict(head), jax.tree.leaves(search.values))


def load_search(path: str | os.PathLike[str], problem: str, like: Any) -> Search:
    """Read a search of a problem whose values have the tree structure and shapes of `like`.

    Raises:
        FileError: no such file, not a search, a damaged one, or one of another problem.
    """
    head_data, arrays = load_checkpoint(path, "a search")
    try:
        head = validate_model(_Head, head_data, "A search")
    except SettingError as error:
        raise FileError(f"{path} is not a search, or it is damaged: {error}") from None
    # Shapes do not tell what values are of: another problem may have the same ones.
    if head.problem != problem:
        raise FileError(
            f"{path} holds a search of another problem: {quote_name(head.problem)}, not {quote_name(problem)}."
        )
    leaves, form = jax.tree.flatten(like)
    # Precisions may differ, since a search of one may be resumed in the other; shapes and kinds of
    # numbers may not.
    forms = lambda every: [(np.shape(leaf), np.asarray(leaf).dtype.kind) for leaf in every]
    if forms(leaves) != forms(arrays):
        raise FileError(
            f"{path} holds values of shapes {format_value([a.shape for a in arrays])}, but "
            f"{format_value([np.shape(leaf) for leaf in leaves])} are needed."
        )
    # A search that resumed from NaN would never leave it.
    if not all(np.all(np.isfinite(a)) for a in arrays) or head.best >= len(head.history):
        raise FileError(f"{path} holds values that are not finite, or a best step beyond its last.")
    values = jax.tree.unflatten(form, [jnp.asarray(a) for a in arrays])
    return Search(values, head.loss, head.history, head.best, SearchReason(head.reason))


def loss_history(history: tuple[float, ...]) -> Figure:
    """Figure of the loss over the steps."""
    figure, axes = grid(1, 1, 3.2)
    # A loss falls by orders of magnitude, of which a linear axis shows only the first.
    axes[0, 0].semilogy(np.arange(len(history)), history, **look(0))
    axes[0, 0].set(xlabel="step", ylabel="loss")
    return figure


def flight_figure(
    ts: np.ndarray, rows: dict[str, dict[str, np.ndarray]], marks: dict[str, list[float]]
) -> Figure:
    """Figure of curves over time, with a panel per "quantity [unit]" and limits as thin grey lines."""
    figure, panels = grid(len(rows), 1, 1.9 * len(rows) + 0.5, sharex=True)
    for axes, (label, curves) in zip(panels[:, 0], rows.items(), strict=True):
        for k, (name, values) in enumerate(curves.items()):
            # Markers of each curve begin a little later, so that curves that coincide are told
            # apart.
            axes.plot(ts, values, **look(k), markevery=(0.03 * k, 0.2), label=name)
        for mark in marks.get(label, []):
            axes.axhline(mark, color="0.3", linewidth=0.6)
        axes.set_ylabel(label, fontsize=9)
        if len(curves) > 1:
            axes.legend(fontsize=7, ncols=min(len(curves), 3))
    panels[-1, 0].set_xlabel("time [s]", fontsize=9)
    return figure


@quick_jit
def _point_differences(motion: TunedMotion) -> Float[Array, "k n"]:
    # Points may hold attitudes, which have no difference by subtraction; the space's difference has
    # a component for each state.
    start = jax.tree.map(lambda x: x[0], motion.points)
    return jax.vmap(lambda now: motion.space.difference(now, start))(motion.points)


def tuned_curves(
    tuning: InputTuning, values: Any, samples: int = 200
) -> tuple[Float[np.ndarray, " k"], dict[str, dict[str, np.ndarray]]]:
    """Times and curves of tuned inputs and their motion, by "quantity [unit]" and name, for figures.

    Coordinates are differences from the start; each unit has a panel.
    """
    motion = tuning.motion(values, samples)
    x, inputs = np.asarray(_point_differences(motion)), np.asarray(motion.inputs)
    rows: dict[str, dict[str, np.ndarray]] = {}
    for k, (name, unit) in enumerate(motion.space.names[: motion.space.dof]):
        rows.setdefault(f"moved by [{unit}]", {})[name] = x[:, k]
    for k, (name, unit) in enumerate(tuning.residuals.system.inputs.names):  # pyright: ignore
        rows.setdefault(f"inputs [{unit}]", {})[name] = inputs[:, k]
    return np.asarray(motion.ts), rows
