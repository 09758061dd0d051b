"""Poses of a saved run's bodies between the saved times, as the viewer's page interpolates them."""

from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ..files.netcdf import FileError
from .content import finite_times


class Poses:
    """Poses of all bodies of a saved run at any time of it.

    Positions are linear between saved times, and orientations turn by the shortest rotation.

    Attributes:
        ts: saved times with finite poses (k,) [s].
        kept: their indices among all saved times (k,).
        positions: of the centres of mass, world axes (k, n, 3) [m].
        orientations: unit Euler parameters, body to world (k, n, 4).
    """

    def __init__(self, run: xr.Dataset) -> None:
        """Take the poses of a saved run.

        Raises:
            FileError: fewer than two saved times have finite poses.
        """
        self.kept = finite_times(run)
        if len(self.kept) < 2:
            raise FileError(
                f"The run of scene '{run.attrs.get('scene', '')}' has one saved time with finite poses, "
                "and nothing moves at one time."
            )
        self.ts: Float[np.ndarray, " k"] = run["time"].values[self.kept]
        self.positions = run["position"].values[self.kept]
        self.orientations = run["euler_parameters"].values[self.kept]

    def between(self, t: float) -> tuple[int, float]:
        """Index of the last saved time up to t [s], and the share of the way to the next."""
        k = int(np.clip(np.searchsorted(self.ts, t, side="right") - 1, 0, len(self.ts) - 2))
        share = (t - self.ts[k]) / (self.ts[k + 1] - self.ts[k])
        return k, float(np.clip(share, 0.0, 1.0))

    def mixed(self, values: Any, t: float) -> Any:
        """Values at the saved times (k, ...), linearly interpolated to t [s]."""
        k, share = self.between(t)
        return (1 - share) * values[k] + share * values[k + 1]

    def at(self, t: float) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
        """Positions (n, 3) [m] and rotation matrices, body to world (n, 3, 3), at t [s]."""
        k, share = self.between(t)
        start, end = (_rotation(self.orientations[i]) for i in (k, k + 1))
        turned = start * Rotation.from_rotvec(share * (start.inv() * end).as_rotvec())
        return self.mixed(self.positions, t), turned.as_matrix()


def _rotation(p: Float[np.ndarray, "n 4"]) -> Rotation:
    """Rotations of Euler parameters, of which SciPy has the scalar last."""
    return Rotation.from_quat(p[:, [1, 2, 3, 0]])
