"""Self-contained page with the moving mechanism of one run, or of two runs side by side.

The page works without network: scripts, style and numbers are in it, and its own content security
policy forbids any request. It draws with three.js and uPlot (docs/viewer.md). Arrays are base64 texts of
little-endian numbers, float64 for times and float32 for all else.
"""

import base64
import html
import json
import os
import re
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation, Slerp

from ..checks.errors import SettingError, nearest_names
from ..checks.numbers import check_vector
from ..checks.shapes import Numbers
from ..control.closed_loop import LoopRun
from ..dynamics.simulation import Run
from ..io.netcdf import FileError, load, write_atomically
from ..io.run_file import loop_to_dataset, to_dataset
from .run import SLIDING
from .shapes import (
    Shape,
    body_poses,
    body_shapes,
    joint_displacement,
    joint_of,
    machine_size,
    rotor_points,
)

# Largest number of saved times in a page: more are thinned out evenly.
MOST_TIMES = 2000

_NEEDED = ("position", "euler_parameters", "mass", "inertia", "centre_of_mass")
_OF_JOINTS = ("joint_point_i", "joint_point_j", "joint_frame_i", "joint_frame_j")

# Variables that have plots of their own, and the largest number of curves of any other.
_SHOWN = (
    "kinetic_energy", "potential_energy", "work", "rotor_thrust", "reaction_force", "reaction_moment",
)  # fmt: skip
_MOST_CURVES = 12

Curves = list[dict[str, Any]]


def content_of(
    run: xr.Dataset, sun: Numbers | None = None, shapes: Mapping[str, Sequence[Shape]] | None = None
) -> dict[str, Any]:
    """Content of the page for one saved run, as plain numbers and texts.

    Args:
        run: saved run, as `load` reads it.
        sun: vector from the ground towards the sun, world axes (3,), of any length.
        shapes: shapes of bodies by name, instead of those of `body_shapes`.

    Raises:
        FileError: the run lacks what the page shows, or has no time with finite poses.
        SettingError: shapes for a body that the run does not have, or a sun without direction.
    """
    check_viewable(run)
    # A browser holds a few thousand poses of many bodies with ease, but not a million.
    time_indices, count, note = finite_times(run), run.sizes["time"], ""
    if len(time_indices) < count:
        note = f"{count - len(time_indices)} of {count} saved times are not finite and left out. "
    if len(time_indices) > MOST_TIMES:
        some = np.unique(np.round(np.linspace(0, len(time_indices) - 1, MOST_TIMES)).astype(int))
        note += f"{MOST_TIMES} of {len(time_indices)} saved times are shown."
        time_indices = time_indices[some]
    run = run.isel(time=time_indices)
    names = [str(name) for name in run["body"].values]
    custom_shapes: dict[str, Sequence[Shape]] = dict(shapes or {})
    for name in custom_shapes:
        if name not in names:
            raise SettingError(f"There is no body '{name}' to draw.{nearest_names(name, names)}")
    solids_by_body = {name: body_shapes(run, name) for name in names} | custom_shapes
    rotors = None
    if "rotor_thrust" in run:
        carriers = [str(name) for name in run["rotor_body"].values]
        points = [point for body in dict.fromkeys(carriers) for point in rotor_points(run, body)]
        rotors = {
            "bodies": carriers, "positions": np.array(points).tolist(), "spin": run["rotor_spin"].values.tolist(),
            "speed": encode_array(run["rotor_speed"].values),
            "thrust": encode_array(run["rotor_thrust"].values),
        }  # fmt: skip
    optional = lambda name: encode_array(run[name].values) if name in run else None
    towards = None
    if sun is not None:
        sun_vector = np.asarray(check_vector(sun, "The direction of the sun", ""))
        length = float(np.linalg.norm(sun_vector))
        if length == 0:
            raise SettingError(
                "The direction of the sun has zero length; give any vector towards it."
            )
        towards = sun_vector / length
    return {
        "title": str(run.attrs.get("title", "")) or str(run.attrs.get("scene", "")) or "Motion",
        "note": note.strip(),
        # Times in double precision: a late one in single precision loses the digits that tell frames apart.
        # Poses in single precision halve the page.
        "times": encode_array(run["time"].values, "<f8"),
        "positions": encode_array(run["position"].values),
        "orientations": encode_array(run["euler_parameters"].values),
        "bodies": [
            {"name": name, "shapes": [shape.to_dict() for shape in solids]}
            for name, solids in solids_by_body.items()
        ],
        "joints": [joint_of(run, k) for k in range(run.sizes.get("joint", 0))],
        "reactions": optional("reaction_force"),
        "reference": optional("reference_position"),
        "rotors": rotors,
        "sun": None if towards is None else towards.tolist(),
        "watch": watched_bodies(run),
        "size": machine_size(run),
        "curves": plot_curves(run, towards),
    }


def check_viewable(run: xr.Dataset) -> None:
    """Raise `FileError` unless a saved run has all that the viewer draws."""
    joints = _OF_JOINTS if run.sizes.get("joint", 0) else ()
    missing = [name for name in (*_NEEDED, *joints) if name not in run]
    if missing:
        raise FileError(
            f"The run of scene '{run.attrs.get('scene', '')}' cannot be drawn, because it was saved "
            f"without {', '.join(missing)}: an earlier version of stmuav_jax did not keep them. "
            "Simulate and save it again."
        )


def encode_array(values: Any, kind: str = "<f4") -> str:
    """Base64 text of an array's numbers in the order of its last index first."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def finite_times(run: xr.Dataset) -> Int[np.ndarray, " k"]:
    """Indices of the saved times at which all poses are finite; `FileError` if there is none."""
    poses = np.concatenate([run["position"].values, run["euler_parameters"].values], axis=2)
    finite_indices = np.flatnonzero(np.all(np.isfinite(poses), axis=(1, 2)))
    if not len(finite_indices):
        raise FileError(
            f"The run of scene '{run.attrs.get('scene', '')}' has no saved time at which all poses are "
            "finite numbers, so that there is nothing to draw."
        )
    return finite_indices


def interpolate_poses(
    run: xr.Dataset, times: Float[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, "k n 3"], Float[np.ndarray, "k n 3 3"]]:
    """Positions [m] and rotation matrices, body to world, of a saved run's bodies at times within it [s].

    Positions are linear between the saved times; orientations turn by the shortest rotation.

    Raises:
        FileError: fewer than two saved times have finite poses.
    """
    finite = finite_times(run)
    if len(finite) < 2:
        raise FileError(
            f"The run of scene '{run.attrs.get('scene', '')}' has one saved time with finite poses, but "
            f"a motion needs two."
        )
    ts, p = run["time"].values[finite], run["euler_parameters"].values[finite]
    # Between saved times bodies turn along the shortest arc; a mean of Euler parameters is no rotation.
    turns = (Slerp(ts, Rotation.from_quat(q, scalar_first=True)) for q in np.moveaxis(p, 1, 0))
    k = np.clip(np.searchsorted(ts, times, side="right") - 1, 0, len(ts) - 2)
    share = ((times - ts[k]) / (ts[k + 1] - ts[k]))[:, None, None]
    r = run["position"].values[finite]
    R_wb = np.stack([turn(times).as_matrix() for turn in turns], axis=1)
    return (1 - share) * r[k] + share * r[k + 1], R_wb


def watched_bodies(run: xr.Dataset) -> list[str]:
    """Names of the bodies that figures of the scene show.

    Where it names none: those with rotors and panels, and without such bodies all.
    """
    return json.loads(run.attrs.get("watch", "[]")) or _upright_bodies(run) or _body_names(run)


def _body_names(run: xr.Dataset) -> list[str]:
    return [str(name) for name in run["body"].values]


def _upright_bodies(run: xr.Dataset) -> list[str]:
    """Names of the bodies whose z axis has a meaning: those with rotors, and panels."""
    return [n for n in _body_names(run) if len(rotor_points(run, n)) or "panel" in n.lower()]


# --- curves


def plot_curves(run: xr.Dataset, sun: Float[np.ndarray, "3"] | None) -> Curves:
    """Curves for the plots: title with unit, and labelled values over the shown times."""
    names, curves_by_title = _body_names(run), {}
    for body in watched_bodies(run):
        r = run["position"].values[:, names.index(body)]
        curves_by_title[f"position of {_spell_name(body)} [m]"] = dict(zip("xyz", r.T, strict=True))
    normals = {
        _spell_name(name): body_poses(run, name)[1][:, :, 2] for name in _upright_bodies(run)
    }
    curves_by_title["tilt of z from the vertical [degrees]"] = {
        name: _angle_degrees(z[:, 2]) for name, z in normals.items()
    }
    if sun is not None:
        curves_by_title["angle from the panel's normal to the sun [degrees]"] = {
            name: _angle_degrees(z @ sun) for name, z in normals.items() if "panel" in name.lower()
        }
    joints = [str(name) for name in run["joint"].values] if "joint" in run else []
    curves_by_title["displacement in joints [m]"] = {
        name: joint_displacement(run, k)
        for k, name in enumerate(joints)
        if str(run["joint_kind"].values[k]) in SLIDING
    }
    if "reaction_force" in run:
        force = np.linalg.norm(run["reaction_force"].values, axis=2)
        curves_by_title["reaction force [N]"] = dict(zip(joints, force.T, strict=True))
    if "rotor_thrust" in run:
        thrust = run["rotor_thrust"].values.T
        curves_by_title["thrust of rotors [N]"] = {
            str(k + 1): history for k, history in enumerate(thrust)
        }
    if "kinetic_energy" in run:
        potential = run["potential_energy"].values
        curves_by_title["energy [J]"] = {
            # The potential has an arbitrary zero; from the start, its change can be compared with the kinetic
            # energy.
            "kinetic": run["kinetic_energy"].values, "potential": potential - potential[0],
            "work done": run["work"].values,
        }  # fmt: skip
    return [
        {
            "title": title,
            "curves": [{"label": k, "values": encode_array(v)} for k, v in values_by_label.items()],
        }
        for title, values_by_label in (curves_by_title | _loop_signals(run)).items()
        if values_by_label
    ]


def _loop_signals(run: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Signals that a closed loop saved: numbers over time, alone or few together."""
    curves_by_title = {}
    for name, variable in run.data_vars.items():
        alone = variable.dims[:1] == ("time",) and variable.dtype.kind == "f"
        columns = variable.values.reshape(run.sizes["time"], -1).T if alone else ()
        # Quantities of every body would be too many curves to read.
        if name in _SHOWN or "body" in variable.dims or not 1 <= len(columns) <= _MOST_CURVES:
            continue
        last = variable.dims[-1]
        labels = run[last].values if last in run.coords else range(1, len(columns) + 1)
        curve_labels = (
            [_spell_name(str(name))] if variable.ndim == 1 else [str(label) for label in labels]
        )
        if len(curve_labels) == len(columns):
            title = f"{_spell_name(str(name))} [{variable.attrs.get('units', '')}]"
            curves_by_title[title] = dict(zip(curve_labels, columns, strict=True))
    return curves_by_title


def _angle_degrees(cosine: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    # the cosine of two unit vectors may exceed 1 by round-off
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _spell_name(name: str) -> str:
    return name.replace("_", " ")


_PARTS = ("library.css", "viewer.css", "library.min.js", "motion.js", "machine.js", "viewer.js")


@dataclass(frozen=True)
class RunPage:
    """Self-contained page of one or two runs; a notebook shows it as the value of a cell.

    Attributes:
        html: text of the page.
        height: height in a notebook [pixels].
    """

    html: str
    height: int = 560

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, atomically; return its path."""
        return write_atomically(path, self.html.encode())

    def show(self) -> Path:
        """Write the page to a temporary file and open it in the browser; return the file's path."""
        handle, name = tempfile.mkstemp(prefix="stmuav-view-", suffix=".html")
        os.close(handle)
        path = self.save(name)
        webbrowser.open(path.as_uri())
        return path

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )


def view(
    *runs: Run | LoopRun | xr.Dataset | str | os.PathLike[str],
    sun: Numbers | None = None,
    shapes: Mapping[str, Sequence[Shape]] | None = None,
) -> RunPage:
    """Page with the moving mechanism of a run, or of two runs side by side.

    Args:
        runs: one or two runs or closed loops' runs; or datasets, files or folders of saved ones.
        sun: vector towards the sun, world axes (3,), of any length; default no sun.
        shapes: shapes of bodies by name (see `Shape`); default by the dimensions in the run.

    Raises:
        FileError: a file is no saved run, or a run lacks what the page shows.
        SettingError: not one or two runs, shapes for an unknown body, or a sun without direction.
    """
    if len(runs) not in (1, 2):
        raise SettingError(f"The viewer shows one run or two side by side, not {len(runs)}.")
    content = {"runs": [content_of(dataset_of(run), sun, shapes) for run in runs]}
    titles = dict.fromkeys(run_content["title"] for run_content in content["runs"])
    # "<" within the numbers and names would end the script element
    # Everything is in one file, which opens without a network and can be sent.
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    assets = Path(__file__).with_name("assets")
    parts = {name: (assets / name).read_text(encoding="utf-8") for name in (*_PARTS, "page.html")}
    parts |= {"title": html.escape(" | ".join(titles)), "data": data}
    # One pass: text that a part brings along is not searched for placeholders.
    page = re.sub(
        r"\{\{([\w.]+)\}\}", lambda placeholder: parts[placeholder[1]], parts["page.html"]
    )
    return RunPage(page)


def dataset_of(run: Run | LoopRun | xr.Dataset | str | os.PathLike[str]) -> xr.Dataset:
    """Labelled dataset of a run: of one in memory, or of a saved one by its file or folder."""
    if isinstance(run, xr.Dataset):
        return run
    if isinstance(run, Run):
        return to_dataset(run)
    if isinstance(run, LoopRun):
        return loop_to_dataset(run)
    path = Path(run)
    if path.is_dir():
        path /= next((n for n in ("run.nc", "flight.nc") if (path / n).exists()), "run.nc")
    return load(path)
