"""Figures of a linear model: its poles with damping lines, and its responses to steps of the inputs."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..checks.errors import SettingError, named_places
from ..flight.linear import AT_ZERO, Linear, Mode
from .plot import STYLES, grid

# Damping ratios with a line, in linear and in logarithmic axes.
_RATIOS, _FEW = (0.1, 0.3, 0.5, 0.7, 0.9), (0.1, 0.5, 0.9)
# Ratio of the largest pole to the smallest above which the axes are logarithmic away from zero.
_WIDE = 50.0
# Largest number of poles that are named beside the map, and of curves in a panel.
_NAMED, _CURVES = 12, len(STYLES)
# Colour and marker of poles that decay, grow, neither, and lie at zero.
_LOOKS = {
    "decays": ("#0072B2", "x"), "grows": ("#D55E00", "D"), "neither": ("#009E73", "s"),
    "at zero": ("#000000", "o"),
}  # fmt: skip


def pole_map(linear: Linear, title: str = "") -> Figure:
    """Figure of the eigenvalues of A in the complex plane, with lines of equal damping ratio.

    Poles are numbered by falling real part; beside the map stand their time constants, frequencies and
    damping ratios, and the states that take part most. A conjugate pair has one number. Where poles differ
    in size by more than a factor of 50, the axes are logarithmic away from zero.

    Args:
        linear: linear model, of `stm.linearize`.
        title: title of the figure.
    """
    modes = linear.modes()
    away = [mode for mode in modes if abs(mode.eigenvalue) > AT_ZERO]
    named = [mode for mode in away if mode.eigenvalue.imag >= 0]
    figure, axes = grid(1, 2, 4.2, width_ratios=[1.15, 1.0])
    ax, beside = axes[0]
    sizes = np.array([abs(mode.eigenvalue) for mode in away])
    most = float(np.max(sizes, initial=0.0)) or 1.0
    least = float(np.min(sizes, initial=most))
    wide = most > _WIDE * least
    growing = any(_kind(mode) == "grows" for mode in away)
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.axvline(0.0, color="0.3", linewidth=0.8)
    _damping_lines(ax, least, 1.3 * most, _FEW if wide else _RATIOS)
    for kind, (color, marker) in _LOOKS.items():
        own = np.array([mode.eigenvalue for mode in modes if _kind(mode) == kind])
        if own.size:
            face = {} if marker == "x" else {"markerfacecolor": "none"}
            count = f"{kind} ({own.size})" if kind == "at zero" else kind
            ax.plot(
                np.real(own), np.imag(own), marker, color=color, markersize=7, label=count, **face
            )
    if wide:
        _logarithmic(ax, most, least, growing)
    else:
        ax.set_xlim(-1.4 * most, 1.4 * most if growing else 0.4 * most)
        ax.set_ylim(-1.4 * most, 1.4 * most)
    for number, mode in enumerate(named[:_NAMED], 1):
        s = mode.eigenvalue
        ax.annotate(f"{number}", (s.real, s.imag), (4, 4), textcoords="offset points", fontsize=8)
    ax.set_xlabel("real part [1/s]", fontsize=9)
    ax.set_ylabel("imaginary part [rad/s]", fontsize=9)
    ax.legend(fontsize=8, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    _names(beside, named)
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def _kind(mode: Mode) -> str:
    s = mode.eigenvalue
    if abs(s) <= AT_ZERO:
        return "at zero"
    if abs(s.real) <= AT_ZERO * abs(s):
        return "neither"
    return "grows" if s.real > 0 else "decays"


def _logarithmic(ax: Axes, most: float, least: float, growing: bool) -> None:
    """Axes that are logarithmic from the smallest pole outwards, with few ticks."""
    first, last = int(np.ceil(np.log10(least))), int(np.floor(np.log10(most)))
    powers = 10.0 ** np.arange(last, first - 1, -max((last - first) // 3, 1))
    for axis, scale, limits in (
        (ax.xaxis, ax.set_xscale, ax.set_xlim), (ax.yaxis, ax.set_yscale, ax.set_ylim),
    ):  # fmt: skip
        scale("symlog", linthresh=least)
        right = 3 * most if growing or axis is ax.yaxis else least
        limits(-3 * most, right)
        axis.set_ticks([-x for x in powers] + [0.0] + [x for x in powers if x < right])


def _damping_lines(ax: Axes, least: float, end: float, ratios: Sequence[float]) -> None:
    """Lines s = w (-d +- i sqrt(1 - d^2)) of damping ratios d, w from zero outwards."""
    size = np.concatenate([[0.0], np.geomspace(0.01 * least, end, 200)])
    for ratio in ratios:
        x, y = -ratio * size, np.sqrt(1 - ratio**2) * size
        for sign in (1, -1):
            label = "damping ratio" if (ratio, sign) == (ratios[0], 1) else None
            ax.plot(
                x,
                sign * y,
                color="0.7",
                linewidth=0.7,
                linestyle=(0, (4, 3)),
                zorder=0,
                label=label,
            )
        ax.annotate(f"{ratio:g}", (x[-1], y[-1]), fontsize=7, color="0.35", ha="center", va="center",
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5}, zorder=1)  # fmt: skip


def _names(ax: Axes, named: Sequence[Mode]) -> None:
    """List of the modes with what they do, in place of axes."""
    ax.set_axis_off()
    lines = [_words(number, mode) for number, mode in enumerate(named[:_NAMED], 1)]
    if len(named) > _NAMED:
        lines.append(f"and {len(named) - _NAMED} more")
    words = "\n".join(lines) or "all poles at zero:\na free rigid body"
    ax.text(
        0.0,
        1.0,
        words,
        transform=ax.transAxes,
        va="top",
        fontsize=7,
        linespacing=1.25,
        parse_math=False,
    )


def _words(number: int, mode: Mode) -> str:
    s, kind = mode.eigenvalue, _kind(mode)
    name, share = mode.states[0]
    states = f"{name} {100 * share:.0f} %"
    if len(mode.states) > 1:
        states += f", {mode.states[1][0]} {100 * mode.states[1][1]:.0f} %"
    said = [] if kind == "neither" else [f"{kind}, time constant {1 / abs(s.real):.3g} s"]
    if abs(s.imag) > AT_ZERO * abs(s):
        said.append(
            f"{mode.frequency:.3g} Hz, damping {0.0 if kind == 'neither' else mode.damping:.3g}"
        )
    return f"{number}  {'; '.join(said)}\n    {states}"


def step_response(
    linear: Linear,
    title: str = "",
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    duration: float | None = None,
) -> Figure:
    """Figure of the outputs' responses to unit steps of the inputs, from rest, a row for each output.

    Args:
        linear: linear model, of `stm.linearize`.
        title: title of the figure.
        inputs: names of inputs that are stepped, by default all; up to four of one unit share a panel,
            others have columns of their own.
        outputs: names of outputs, by default all.
        duration: end [s]; by default that of `Linear.settling_time`.

    Raises:
        SettingError: an unknown name, a model without inputs, or a duration that is not positive.
    """
    if not linear.inputs:
        raise SettingError("The linear model has no inputs that could be stepped.")
    which = _chosen(linear.inputs, inputs, "The inputs", "input")
    rows = _chosen(linear.outputs, outputs, "The outputs", "output")
    ts, found = linear.step(duration)
    columns = _columns(linear, which)
    figure, axes = grid(len(rows), len(columns), 1.1 + 1.4 * len(rows), sharex=True)
    for column, own in enumerate(columns):
        for ax, row in zip(axes[:, column], rows, strict=True):
            for look, k in enumerate(own):
                color, dash = STYLES[look]
                ax.plot(ts, found[:, row, k], color=color, linestyle=dash, linewidth=1.4,
                        label=_step_words(linear, k))  # fmt: skip
            if column == 0:
                name, unit = linear.outputs[row]
                ax.set_ylabel(f"{name}\n[{unit}]", fontsize=8, parse_math=False)
        # above the exponent of the axis
        axes[0, column].legend(
            fontsize=8 if len(columns) < 3 else 7, ncols=2 if len(columns) == 1 else 1,
            loc="lower center", bbox_to_anchor=(0.5, 1.08), frameon=False,
        )  # fmt: skip
        axes[-1, column].set_xlabel("time after the step [s]", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def _columns(linear: Linear, which: Sequence[int]) -> list[list[int]]:
    """Inputs in groups of one unit, as many as a panel has curves."""
    units = [linear.inputs[k][1] for k in which]
    found = []
    for unit in dict.fromkeys(units):
        own = [k for k, each in zip(which, units, strict=True) if each == unit]
        found += [own[k : k + _CURVES] for k in range(0, len(own), _CURVES)]
    return found


def _step_words(linear: Linear, k: int) -> str:
    """Words for a unit step of an input; inputs of one name are numbered."""
    names = [name for name, _ in linear.inputs]
    name, unit = linear.inputs[k]
    if names.count(name) > 1:
        name = f"{name} {names[: k + 1].count(name)}"
    return f"{name}, 1 {unit}"


def _chosen(
    named: Sequence[tuple[str, str]], wanted: Sequence[str] | None, what: str, kind: str
) -> list[int]:
    """Places of the wanted names; a name of several entries stands for all of them."""
    names = [name for name, _ in named]
    if wanted is None:
        return list(range(len(names)))
    found = named_places(wanted, list(dict.fromkeys(names)), what, kind)
    unique = list(dict.fromkeys(names))
    return [k for place in found for k, name in enumerate(names) if name == unique[place]]
