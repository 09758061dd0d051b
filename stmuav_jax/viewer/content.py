"""Content of the viewer's page for one run: poses, shapes, joints, arrows and curves over time.

Arrays are base64 texts of little-endian numbers, float64 for times and float32 for all else.
"""

import base64
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from ..checks.errors import SettingError, nearest_names
from ..checks.numbers import vector
from ..checks.shapes import Numbers
from ..files.netcdf import FileError
from ..mechanics.body import GROUND
from .shapes import SLIDING, Shape, body_shapes, centre, joint_points, rotor_points

# Largest number of saved times in a page: more are thinned out evenly.
MOST_TIMES = 2000

_NEEDED = ("position", "euler_parameters", "mass", "inertia", "centre_of_mass")
_OF_JOINTS = ("joint_point_i", "joint_point_j", "joint_frame_i", "joint_frame_j")

# Variables that have plots of their own, and the largest number of curves of any other.
_SHOWN = (
    "kinetic_energy",
    "potential_energy",
    "work",
    "rotor_thrust",
    "reaction_force",
    "reaction_moment",
)
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
    shown, note = _shown_times(run)
    run = run.isel(time=shown)
    names = [str(name) for name in run["body"].values]
    own = dict(shapes or {})
    for name in own:
        if name not in names:
            raise SettingError(f"There is no body '{name}' to draw.{nearest_names(name, names)}")
    towards = None if sun is None else _direction(sun)
    return {
        "title": str(run.attrs.get("title", "")) or str(run.attrs.get("scene", "")) or "Motion",
        "note": note,
        "times": encoded(run["time"].values, "<f8"),
        "positions": encoded(run["position"].values),
        "orientations": encoded(run["euler_parameters"].values),
        "bodies": [
            {
                "name": name,
                "shapes": [shape.to_dict() for shape in own.get(name, body_shapes(run, name))],
            }
            for name in names
        ],
        "joints": [joint_of(run, k) for k in range(run.sizes.get("joint", 0))],
        "reactions": encoded(run["reaction_force"].values) if "reaction_force" in run else None,
        "wanted": encoded(run["wanted_position"].values) if "wanted_position" in run else None,
        "rotors": _rotors(run),
        "sun": None if towards is None else towards.tolist(),
        "watch": watched(run),
        "size": machine_size(run),
        "curves": curves(run, towards),
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


def encoded(values: Any, kind: str = "<f4") -> str:
    """Base64 text of an array's numbers in the order of its last index first."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def finite_times(run: xr.Dataset) -> Int[np.ndarray, " k"]:
    """Indices of the saved times at which all poses are finite; `FileError` if there is none."""
    finite = np.all(np.isfinite(run["position"].values), axis=(1, 2))
    finite &= np.all(np.isfinite(run["euler_parameters"].values), axis=(1, 2))
    kept = np.flatnonzero(finite)
    if not len(kept):
        raise FileError(
            f"The run of scene '{run.attrs.get('scene', '')}' has no saved time at which all poses are "
            "finite numbers, so that there is nothing to draw."
        )
    return kept


def _shown_times(run: xr.Dataset) -> tuple[np.ndarray, str]:
    """Indices of the saved times that are shown, and a sentence about the others."""
    kept, count = finite_times(run), run.sizes["time"]
    note = ""
    if len(kept) < count:
        note = f"{count - len(kept)} of {count} saved times are not finite and left out. "
    if len(kept) > MOST_TIMES:
        some = np.unique(np.round(np.linspace(0, len(kept) - 1, MOST_TIMES)).astype(int))
        note += f"{MOST_TIMES} of {len(kept)} saved times are shown."
        kept = kept[some]
    return kept, note.strip()


def _direction(sun: Numbers) -> Float[np.ndarray, "3"]:
    found = np.asarray(vector(sun, "The direction of the sun", ""))
    length = float(np.linalg.norm(found))
    if length == 0:
        raise SettingError("The direction of the sun has zero length; give any vector towards it.")
    return found / length


def watched(run: xr.Dataset) -> list[str]:
    """Names of the bodies that figures of the scene show.

    Where it names none: those with rotors and panels, and without such bodies all.
    """
    return json.loads(run.attrs.get("watch", "[]")) or _upright(run) or _names(run)


def _names(run: xr.Dataset) -> list[str]:
    return [str(name) for name in run["body"].values]


def _upright(run: xr.Dataset) -> list[str]:
    """Names of the bodies whose z axis has a meaning: those with rotors, and panels."""
    return [n for n in _names(run) if len(rotor_points(run, n)) or "panel" in n.lower()]


def _poses(run: xr.Dataset, body: str) -> tuple[Any, Any]:
    """Positions (k, 3) [m] and rotation matrices (k, 3, 3) of a body or ground at all times."""
    count = run.sizes["time"]
    if body == GROUND:
        return np.zeros((count, 3)), np.broadcast_to(np.eye(3), (count, 3, 3))
    k = list(run["body"].values).index(body)
    e = run["euler_parameters"].values[:, k]
    turned = Rotation.from_quat(e[:, [1, 2, 3, 0]]).as_matrix()
    return run["position"].values[:, k], turned


def joint_of(run: xr.Dataset, k: int) -> dict[str, Any]:
    """Plain data of a joint, with points from the bodies' centres of mass."""
    i, j = (str(run[f"joint_body_{side}"].values[k]) for side in ("i", "j"))
    point_i = run["joint_point_i"].values[k] - centre(run, i)
    point_j = run["joint_point_j"].values[k] - centre(run, j)
    frame_i, kind = run["joint_frame_i"].values[k], str(run["joint_kind"].values[k])
    found = {
        "name": str(run["joint"].values[k]), "kind": kind, "body_i": i, "body_j": j,
        "point_i": point_i.tolist(), "point_j": point_j.tolist(),
        "frame_i": frame_i.tolist(), "frame_j": run["joint_frame_j"].values[k].tolist(),
    }  # fmt: skip
    if kind in SLIDING:
        along = displacement(run, k)
        found["slide"] = [float(np.min(along)), float(np.max(along))]
    return found


def displacement(run: xr.Dataset, k: int) -> Float[np.ndarray, " t"]:
    """Displacement of a joint's point on body j along the axis on body i (t,) [m]."""
    ends = []
    for side in ("i", "j"):
        body = str(run[f"joint_body_{side}"].values[k])
        r, R = _poses(run, body)
        ends.append(r + R @ (run[f"joint_point_{side}"].values[k] - centre(run, body)))
    R_i = _poses(run, str(run["joint_body_i"].values[k]))[1]
    return np.sum((ends[1] - ends[0]) * (R_i @ run["joint_frame_i"].values[k][:, 2]), axis=1)


def _rotors(run: xr.Dataset) -> dict[str, Any] | None:
    if "rotor_thrust" not in run:
        return None
    at, bodies = [], [str(name) for name in run["rotor_body"].values]
    for body in dict.fromkeys(bodies):
        at += rotor_points(run, body).tolist()
    return {
        "bodies": bodies, "positions": at, "spin": run["rotor_spin"].values.tolist(),
        "speed": encoded(run["rotor_speed"].values),
        "thrust": encoded(run["rotor_thrust"].values),
    }  # fmt: skip


def machine_size(run: xr.Dataset) -> float:
    """Diagonal [m] of the box around all joints, rotors and centres of mass at the start."""
    found = [run["position"].values[0]]
    for body in (str(name) for name in run["body"].values):
        r, R = _poses(run, body)
        for points in (joint_points(run, body)[0], rotor_points(run, body)):
            found.append(r[0] + points @ R[0].T)
    every = np.concatenate(found)
    diagonal = float(np.linalg.norm(np.max(every, axis=0) - np.min(every, axis=0)))
    gyration = np.sqrt(
        np.max(np.linalg.eigvalsh(run["inertia"].values)[:, -1] / run["mass"].values)
    )
    return max(diagonal, 3 * float(gyration))


# --- curves


def curves(run: xr.Dataset, sun: Float[np.ndarray, "3"] | None) -> Curves:
    """Curves for the plots: title with unit, and labelled values over the shown times."""
    names, found = _names(run), {}
    for body in watched(run):
        r = run["position"].values[:, names.index(body)]
        found[f"position of {_words(body)} [m]"] = dict(zip("xyz", r.T, strict=True))
    normals = {_words(name): _poses(run, name)[1][:, :, 2] for name in _upright(run)}
    found["tilt of z from the vertical [degrees]"] = {
        name: _angle(z[:, 2]) for name, z in normals.items()
    }
    if sun is not None:
        found["angle from the panel's normal to the sun [degrees]"] = {
            name: _angle(z @ sun) for name, z in normals.items() if "panel" in name.lower()
        }
    joints = [str(name) for name in run["joint"].values] if "joint" in run else []
    found["displacement in joints [m]"] = {
        name: displacement(run, k)
        for k, name in enumerate(joints)
        if str(run["joint_kind"].values[k]) in SLIDING
    }
    if "reaction_force" in run:
        force = np.linalg.norm(run["reaction_force"].values, axis=2)
        found["reaction force [N]"] = dict(zip(joints, force.T, strict=True))
    if "rotor_thrust" in run:
        thrust = run["rotor_thrust"].values.T
        found["thrust of rotors [N]"] = {str(k + 1): each for k, each in enumerate(thrust)}
    if "kinetic_energy" in run:
        potential = run["potential_energy"].values
        found["energy [J]"] = {
            "kinetic": run["kinetic_energy"].values, "potential": potential - potential[0],
            "work done": run["work"].values,
        }  # fmt: skip
    return [
        {"title": title, "curves": [{"label": k, "values": encoded(v)} for k, v in own.items()]}
        for title, own in (found | _signals(run)).items()
        if own
    ]


def _signals(run: xr.Dataset) -> dict[str, dict[str, Any]]:
    """Signals that a closed loop saved: numbers over time, alone or few together."""
    found = {}
    for name, variable in run.data_vars.items():
        alone = variable.dims[:1] == ("time",) and variable.dtype.kind == "f"
        columns = variable.values.reshape(run.sizes["time"], -1).T if alone else ()
        if name in _SHOWN or "body" in variable.dims or not 1 <= len(columns) <= _MOST_CURVES:
            continue
        last = variable.dims[-1]
        labels = run[last].values if last in run.coords else range(1, len(columns) + 1)
        own = [_words(str(name))] if variable.ndim == 1 else [str(label) for label in labels]
        if len(own) == len(columns):
            title = f"{_words(str(name))} [{variable.attrs.get('units', '')}]"
            found[title] = dict(zip(own, columns, strict=True))
    return found


def _angle(cosine: Float[np.ndarray, " t"]) -> Float[np.ndarray, " t"]:
    # the cosine of two unit vectors may exceed 1 by round-off
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def _words(name: str) -> str:
    return name.replace("_", " ")
