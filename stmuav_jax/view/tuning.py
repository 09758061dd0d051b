"""Files and figures of searches, tuned inputs and linear models."""

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from ..study.linear import Linear
from ..study.search import Search, SearchReason
from .io import FileError, write_atomically
from .plot import save_all

_FORMAT = "stmuav_jax search"


def save_linear(linear: Linear, path: str | os.PathLike[str]) -> Path:
    """Write A, B, C, D and the names with units of states, inputs and outputs (npz)."""
    names = {
        kind: np.array([f"{name} [{unit}]" for name, unit in getattr(linear, kind)])
        for kind in ("states", "inputs", "outputs")
    }
    content = io.BytesIO()
    matrices = {name: getattr(linear, name) for name in "ABCD"}
    np.savez(content, **matrices, **names)  # pyright: ignore[reportArgumentType]
    return write_atomically(path, content.getvalue())


def save_search(search: Search, problem: str, path: str | os.PathLike[str]) -> Path:
    """Write where a search stands, to go on with `load_search`.

    Args:
        problem: what is searched; a search of another problem will not be loaded for it.
    """
    leaves = jax.tree.leaves(search.values)
    head = {
        "format": _FORMAT,
        "problem": problem,
        "loss": search.loss,
        "history": list(search.history),
        "best": search.best,
        "reason": int(search.reason),
    }
    content = io.BytesIO()
    arrays = {f"leaf_{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
    np.savez(content, head=np.array(json.dumps(head)), **arrays)  # pyright: ignore[reportArgumentType]
    return write_atomically(path, content.getvalue())


def load_search(path: str | os.PathLike[str], problem: str, like: Any) -> Search:
    """Read a search of a problem whose values have the form of `like`.

    Raises:
        FileError: no such file, not a search, or one of another problem.
    """
    try:
        with np.load(io.BytesIO(Path(path).read_bytes()), allow_pickle=False) as content:
            head = json.loads(str(content["head"]))
            arrays = [content[f"leaf_{k}"] for k in range(len(content.files) - 1)]
    except FileNotFoundError:
        raise FileError(f"There is no file {path} to go on from.") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(f"{path} is not a search, or it is damaged: {error}") from None
    if head.get("format") != _FORMAT:
        raise FileError(f"{path} is not a search.")
    if head["problem"] != problem:
        raise FileError(
            f"{path} holds a search of another problem: '{head['problem']}', not '{problem}'."
        )
    leaves, form = jax.tree.flatten(like)
    if [np.shape(leaf) for leaf in leaves] != [a.shape for a in arrays]:
        raise FileError(
            f"{path} holds values of shapes {[a.shape for a in arrays]}, where "
            f"{[np.shape(leaf) for leaf in leaves]} are wanted."
        )
    values = jax.tree.unflatten(form, [jnp.asarray(a) for a in arrays])
    history = tuple(float(x) for x in head["history"])
    return Search(values, head["loss"], history, head["best"], SearchReason(head["reason"]))


def loss_history(history: tuple[float, ...]) -> Figure:
    """Loss by step."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(5.0, 3.2), layout="constrained")
        axes = figure.subplots()
        axes.semilogy(np.arange(len(history)), history, marker=".", lw=1)
        axes.set_xlabel("step")
        axes.set_ylabel("loss")
        axes.grid(alpha=0.3)
    return figure


def flight_figure(
    ts: np.ndarray, rows: dict[str, dict[str, np.ndarray]], marks: dict[str, list[float]]
) -> Figure:
    """Curves over time: a panel per row, labelled "quantity [unit]"; limits as dashed lines."""
    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(6.4, 1.9 * len(rows) + 0.5), layout="constrained")
        panels = np.atleast_1d(figure.subplots(len(rows), 1, sharex=True))
        for axes, (label, curves) in zip(panels, rows.items(), strict=True):
            for name, values in curves.items():
                axes.plot(ts, values, lw=1.2, label=name)
            for mark in marks.get(label, []):
                axes.axhline(mark, color="0.4", lw=0.8, ls="--")
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            if len(curves) > 1:
                axes.legend(fontsize=7, ncols=min(len(curves), 3))
        panels[-1].set_xlabel("t [s]")
    return figure


def save_tuning_figures(
    figures: dict[str, Figure], folder: str | os.PathLike[str], suffix: str = "png"
) -> list[Path]:
    """Write figures by name (png, pdf or svg); their paths."""
    makers = {name: lambda _, figure=figure: figure for name, figure in figures.items()}
    return save_all(makers, None, folder, suffix, 200)
