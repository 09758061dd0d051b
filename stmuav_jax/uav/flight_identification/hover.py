"""Centre of mass of a multirotor from the commands of a hover alone.

On average a hovering vehicle does not turn, so its centre of mass is that of the thrusts,

    c = sum_k sum_i T_i(u_ik) a_i / sum_k sum_i T_i(u_ik),

if the motors are equal. A battery's voltage that scales all thrusts alike cancels. If the relative slope
of the thrust at hover differs from that of the layout's shape, c is wrong by the ratio of the two.
"""

import numpy as np
from jaxtyping import Float

from ...checks.errors import SettingError
from .record import RotorLayout, compute_thrust_shape
from .stages import ParameterEstimate, combine_parts

# Block of correlated values and shortest hover [s], and number of windows.
_BLOCK, _SHORTEST, _WINDOWS = 1.0, 4.0, 4


def identify_hover_centre(
    ts: Float[np.ndarray, " k"], commands: Float[np.ndarray, "k n"], layout: RotorLayout
) -> tuple[ParameterEstimate, ParameterEstimate]:
    """Centre of mass along x and y from a hover, from the layout's origin [m].

    The deviation has those of blocks of one second, and the scatter of four windows beyond theirs. What
    is common to flights of one machine, such as motors that differ, is not in it: the difference of two
    flights shows a payload.

    Args:
        ts: times [s]. commands: of the rotors, 0 to 1. layout: rotors in the order of the commands.

    Raises:
        SettingError: the hover is shorter than 4 s, or has another number of rotors.
    """
    if commands.shape[1] != len(layout.positions):
        raise SettingError(
            f"The hover has commands of {commands.shape[1]} rotors, but the layout has {len(layout.positions)}."
        )
    if not ts[-1] - ts[0] >= _SHORTEST:
        raise SettingError(
            f"The hover is {ts[-1] - ts[0]:.3g} s long; {_SHORTEST:g} s or more would be valid."
        )
    T = compute_thrust_shape(commands, layout.thrust_model_factor)
    # The incomplete second at the end joins the block before it: a block of a few samples would
    # scatter more than the others.
    block = np.minimum((ts - ts[0]) // _BLOCK, (ts[-1] - ts[0]) // _BLOCK - 1).astype(int)
    count = block[-1] + 1
    total = np.bincount(block, np.sum(T, axis=1))
    estimates = []
    for axis, letter in enumerate("xy"):
        moment = np.bincount(block, T @ layout.positions[:, axis])
        value = float(np.sum(moment) / np.sum(total))
        rest = moment - value * total
        # The value was fitted to the blocks, which takes one of their degrees of freedom.
        scale = np.sqrt(count / (count - 1)) / np.sum(total)
        blocks = float(np.sqrt(np.sum(rest**2)) * scale)
        white = T @ layout.positions[:, axis] - value * np.sum(T, axis=1)
        windows = np.array_split(np.arange(count), min(_WINDOWS, count))
        values = np.array([np.sum(moment[w]) / np.sum(total[w]) for w in windows])
        spread = np.array([blocks * np.sqrt(count / len(w)) for w in windows])
        parts = (np.sqrt(np.sum(white**2)) / np.sum(total), blocks, 0.0, values, spread)
        name = f"centre of mass {letter} by hover, equal motors"
        estimates.append(combine_parts(name, "m", value, *parts))
    return estimates[0], estimates[1]
