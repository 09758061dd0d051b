"""The tracker built from its lengths, so that geometries can be varied and still close.

docs/geometry.md: lengths, their fitted values and standard deviations. The package makes every
joint from them, so the mechanism closes exactly for any lengths for which it can stand.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from stmuav_jax import PART_I, PART_II, Joint, Scene, make_scene

Array = jax.Array

# Lengths [m] and angles [rad] in the order of a design vector: adopted value, standard deviation.
DESIGN: dict[str, tuple[float, float]] = {
    "a": (0.0920, 0.0012), "b": (0.0709, 0.0010), "h": (0.0145, 0.0021), "r": (0.0840, 0.0069),
    "z_O": (0.0632, 0.0050), "L_5": (0.0950, 0.0005), "L_6": (0.0950, 0.0005),
    "s4": (0.0361, 0.0050), "c": (0.0202, 0.0015), "d": (0.0012, 0.0053),
    "phi": (-0.2674, 0.007), "theta": (-0.3088, 0.007),
}  # fmt: skip

# How far the post's centre of mass lies beside its axis [m].
_POST_ASIDE = 0.0035


_SPREAD = np.array([deviation for _, deviation in DESIGN.values()])


def adopted() -> np.ndarray:
    """The design vector of the package's tables."""
    return np.array([value for value, _ in DESIGN.values()])


def sample(count: int, seed: int) -> np.ndarray:
    """Design vectors (count, 12), independent normal; the first is the adopted one.

    The fit's correlations are not used, so this is wider than the fit.
    """
    noise = np.random.default_rng(seed).normal(size=(count, len(DESIGN)))
    noise[0] = 0.0
    return adopted() + noise * _SPREAD


def deviations(designs: np.ndarray) -> np.ndarray:
    """How many standard deviations the farthest length of each design is off, (k,)."""
    return np.max(np.abs(designs - adopted()) / _SPREAD, axis=1)


def geometry(design: Array) -> dict[str, Array]:
    """Parameters of lengths and posture for one design vector."""
    a, b, h, r, z_o, length_5, length_6, s4, c, d, phi, theta = design
    return {
        "geometry.hinge": z_o,
        "geometry.post": r,
        "geometry.arms": jnp.stack([a, a]),
        "geometry.panel_arms": jnp.stack([b, b]),
        "geometry.panel_depths": jnp.stack([h, h]),
        # leg 2 has rod 6, leg 3 rod 5
        "geometry.rods": jnp.stack([length_6, length_5]),
        "geometry.post_com": jnp.stack([jnp.asarray(_POST_ASIDE), jnp.zeros(()), s4]),
        "geometry.panel_com": jnp.stack([-c, c, d]),
        "posture.phi": phi,
        "posture.theta": theta,
    }


def _swap(joint: Joint, swapped: bool | Array) -> Joint:
    """Universal joint 3-5 with its axes in the other order.

    x is then fixed in the slider, and in the rod the perpendicular to x and the rod. The
    slider is not turned at the start, so the base's axes are the slider's.
    """
    R = joint.frame_i @ joint.frame_j.T
    x = jnp.array([1.0, 0.0, 0.0])
    across = jnp.cross(R @ jnp.array([0.0, 0.0, 1.0]), x)
    y = across / jnp.sqrt(across @ across)
    frame = jnp.stack([x, y, jnp.cross(x, y)], axis=1)
    return dataclasses.replace(
        joint,
        frame_i=jnp.where(swapped, frame, joint.frame_i),
        frame_j=jnp.where(swapped, R.T @ frame, joint.frame_j),
    )


def varied_scene(name: str, case: int, design: Array, *, swapped: bool | Array = False) -> Scene:
    """A scene of the report with the tracker of one design vector.

    `swapped` gives universal joint 3-5 its axes in the other order.
    """
    table = PART_I if name == "tracker" else PART_II
    scene = make_scene(name, case, table.replaced(geometry(design), "a varied design"))
    at = next(k for k, joint in enumerate(scene.system.joints) if joint.name == "U35")
    turned = _swap(scene.system.joints[at], swapped)
    system = eqx.tree_at(lambda s: s.joints[at], scene.system, turned)
    return dataclasses.replace(scene, system=system)
