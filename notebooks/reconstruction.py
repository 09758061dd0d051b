"""The tracker's lengths from the report's printed tables, by weighted least squares.

Table 6.1 of Part I prints the centres of mass r_i and initial Euler parameters p_i of the
bodies. The lengths, the panel's angles and where the centres of mass are on their bodies are
unknown; for any values of them `place` gives the r_i and p_i of a mechanism that closes. The
fit minimises

    sum ((r - r printed) / 0.5 mm)^2 + sum ((p - p printed) / 0.002 or 0.004)^2
        + sum ((rod's centre of mass - 1/2) / 0.02)^2,

0.004 for bodies 5 and 7, whose printed p are the least consistent. What has to be decided
before that (misprints, the order of a joint's axes, what is taken as equal) is a `Reading`;
fitting each and comparing their sums is the evidence for the choices of docs/report_machine.md.

    python notebooks/reconstruction.py

prints the fit and the comparison.

Source: report Part I, Table 6.1, as printed; joints: Part II, section 3.1.
"""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float

from stmuav_jax import SettingError, rotation
from stmuav_jax.uav import PRINTED_CENTRES, PRINTED_ORIENTATIONS
from stmuav_jax.uav import TRACKER_BODIES, TrackerGeometry, place

POSITION_DEVIATION = 5e-4  # [m]
EULER_DEVIATION = {"post_4": 0.002, "rod_5": 0.004, "rod_6": 0.002, "panel_7": 0.004}
MIDDLE_DEVIATION = 0.02  # of a rod's centre of mass from its middle, in rod lengths
RESTORED_E0 = 0.9794  # e0 with which p_7 has norm 1

_PRINTED = np.array([PRINTED_CENTRES[name] for name in TRACKER_BODIES])
_SPREAD = np.array(list(EULER_DEVIATION.values()))[:, None]
# e2 and e3 of p_4, e1 and e3 of p_6 are zero whatever the lengths are
_ALWAYS_ZERO = 4

# The unknowns: a rough start, and the size of a step [m], [rad] or [1]. Leg 2 has rod 6; what
# ends in _more is what leg 3 has beyond it.
UNKNOWNS: dict[str, tuple[float, float]] = {
    "axis_x": (-0.015, 1e-3),
    "axis_y": (0.015, 1e-3),
    "hinge": (0.06, 1e-3),
    "post": (0.09, 1e-3),
    "arm": (0.09, 1e-3),
    "panel_arm": (0.07, 1e-3),
    "panel_depth": (0.01, 1e-3),
    "rod": (0.1, 1e-3),
    "slider_reach": (0.11, 1e-3),
    "slider_up": (0.0, 1e-3),
    "post_aside": (0.0, 1e-3),
    "post_up": (0.04, 1e-3),
    "middle_6": (0.5, 0.01),
    "middle_5": (0.5, 0.01),
    "panel_out": (0.02, 1e-3),
    "panel_up": (0.0, 1e-3),
    "phi": (-0.25, 0.01),
    "theta": (-0.3, 0.01),
    "rod_more": (0.0, 1e-3),
    "arm_more": (0.0, 1e-3),
    "panel_arm_more": (0.0, 1e-3),
    "panel_depth_more": (0.0, 1e-3),
}
_START = np.array([start for start, _ in UNKNOWNS.values()])
_SIZE = np.array([size for _, size in UNKNOWNS.values()])
_HELD: dict[str, tuple[str, ...]] = {
    "one rod": ("rod_more", "arm_more", "panel_arm_more", "panel_depth_more"),
    "symmetric": ("arm_more", "panel_arm_more", "panel_depth_more"),
    "arms apart": ("panel_arm_more", "panel_depth_more"),
    "panel arms apart": ("arm_more", "panel_depth_more"),
    "depths apart": ("arm_more", "panel_arm_more"),
    "uneven": (),
}


@dataclass(frozen=True)
class Reading:
    """How the printed tables and the lost figures are read.

    Attributes:
        post: sign of e1 of p_4; "negative", or "printed" (positive).
        panel: p_7, printed with norm 0.9974: "restored" (e0 = 0.9794), "printed", or
            "normalised".
        cross: universal joint 3-5 with its y axis in the slider and x in the rod ("yx"), or
            the other way.
        design: what both legs share. "symmetric": arms, panel arms, depths; "one rod": the
            rods' length as well; "arms apart" and so on: less; "uneven": none of these.
    """

    post: Literal["negative", "printed"] = "negative"
    panel: Literal["restored", "printed", "normalised"] = "restored"
    cross: Literal["yx", "xy"] = "yx"
    design: Literal[
        "symmetric", "one rod", "arms apart", "panel arms apart", "depths apart", "uneven"
    ] = "symmetric"

    def free(self) -> Bool[np.ndarray, " k"]:
        """Which of `UNKNOWNS` are fitted; the others stay at their start."""
        return np.array([name not in _HELD[self.design] for name in UNKNOWNS])

    def orientations(self) -> Float[np.ndarray, "4 4"]:
        """Euler parameters of bodies 4 to 7 as they are read."""
        p = np.array([PRINTED_ORIENTATIONS[name] for name in EULER_DEVIATION])
        if self.post == "negative":
            p[0, 1] *= -1
        if self.panel == "restored":
            p[3, 0] = RESTORED_E0
        if self.panel == "normalised":
            p[3] /= np.linalg.norm(p[3])
        return p


def mechanism(values: Float[Array | np.ndarray, " k"]) -> tuple[TrackerGeometry, Float[Array, "2"]]:
    """The lengths and panel angles (phi, theta) that values of `UNKNOWNS` stand for."""
    u = dict(zip(UNKNOWNS, jnp.asarray(values), strict=True))
    pair = lambda name: jnp.stack([u[name], u[name] + u[f"{name}_more"]])
    both = lambda name: jnp.stack([u[name], u[name]])
    arms = pair("arm")
    geometry = TrackerGeometry(
        axis=jnp.stack([u["axis_x"], u["axis_y"]]),
        hinge=u["hinge"],
        post=u["post"],
        arms=arms,
        panel_arms=pair("panel_arm"),
        panel_depths=pair("panel_depth"),
        rods=pair("rod"),
        slider_out=u["slider_reach"] - arms,
        slider_up=both("slider_up"),
        post_com=jnp.stack([u["post_aside"], jnp.zeros_like(u["post"]), u["post_up"]]),
        rod_com=jnp.stack([u["middle_6"], u["middle_5"]]),
        panel_com=jnp.stack([-u["panel_out"], u["panel_out"], u["panel_up"]]),
    )
    return geometry, jnp.stack([u["phi"], u["theta"]])


def predicted(
    geometry: TrackerGeometry,
    angles: Float[Array, "2"],
    other_cross: Bool[Array, ""] | bool = False,
) -> tuple[Float[Array, "6 3"], Float[Array, "4 4"]]:
    """Centres of mass of bodies 2 to 7 [m] and Euler parameters of 4 to 7."""
    at = place(geometry, angles)
    along = rotation.rotation_matrix(at.p[3])[:, 2]
    aside = jnp.arctan2(along[0], jnp.sqrt(along[1] ** 2 + along[2] ** 2))
    turn = rotation.turn_about
    other = rotation.product(turn(jnp.arctan2(-along[1], along[2]), 0), turn(aside, 1))
    return at.r, at.p[2:].at[1].set(jnp.where(other_cross, other, at.p[3]))


class _Problem(NamedTuple):
    """A reading as numbers, so that one compilation serves all."""

    free: Array
    orientations: Array
    other_cross: Array


def _misfits(steps: Float[Array, " k"], problem: _Problem) -> Float[Array, "36"]:
    """In standard deviations: positions (18), Euler parameters (16), rods' middles (2)."""
    values = _START + _SIZE * problem.free * steps
    r, p = predicted(*mechanism(values), problem.other_cross)
    names = list(UNKNOWNS)
    middles = jnp.stack([values[names.index(k)] - 0.5 for k in ("middle_6", "middle_5")])
    parts = (
        (r - _PRINTED) / POSITION_DEVIATION,
        (p - problem.orientations) / _SPREAD,
        middles / MIDDLE_DEVIATION,
    )
    return jnp.concatenate([part.reshape(-1) for part in parts])


@jax.jit
def _minimise(
    first: Float[Array, " k"], problem: _Problem
) -> tuple[Float[Array, " k"], Float[Array, "36"], Float[Array, "36 k"], Bool[Array, ""]]:
    """Steps at the minimum, the misfits and their Jacobian there, and whether it converged."""
    solution = optimistix.least_squares(
        _misfits,
        optimistix.LevenbergMarquardt(rtol=1e-10, atol=1e-10),
        first,
        args=problem,
        max_steps=2000,
        throw=False,
    )
    steps, good = solution.value, solution.result == optimistix.RESULTS.successful
    return steps, _misfits(steps, problem), jax.jacfwd(_misfits)(steps, problem), good


@dataclass(frozen=True)
class Fit:
    """A fitted geometry.

    Attributes:
        reading: what was fitted. converged: whether the minimum was found.
        values, standard_deviations: of the fitted unknowns by name [m], [rad], [1].
        chi_square: the weighted sum of squares. freedom: numbers that can differ less unknowns.
        correlations: of the fitted unknowns, in the order of `values` (k, k).
        position_errors: centres of mass less printed, bodies 2 to 7 (6, 3) [m].
        euler_errors: Euler parameters less those read, bodies 4 to 7 (4, 4).
        euler_deviations: standard deviations of the fitted Euler parameters (4, 4).
        geometry, angles: the mechanism, and (phi, theta) [rad].
    """

    reading: Reading
    converged: bool
    values: dict[str, float]
    standard_deviations: dict[str, float]
    chi_square: float
    freedom: int
    correlations: np.ndarray = field(repr=False)
    position_errors: np.ndarray = field(repr=False)
    euler_errors: np.ndarray = field(repr=False)
    euler_deviations: np.ndarray = field(repr=False)
    geometry: TrackerGeometry = field(repr=False)
    angles: np.ndarray = field(repr=False)

    def rms(self, *, base: bool = True) -> float:
        """Root mean square distance to the printed centres of mass [m].

        Args:
            base: over all seven; body 1 has no unknown and counts as 0. Without, over six.
        """
        return rms(self.position_errors, base=base)

    def worst(self) -> float:
        """The largest distance to a printed centre of mass [m]."""
        return float(np.linalg.norm(self.position_errors, axis=1).max())


def rms(errors: Float[np.ndarray, "6 3"], *, base: bool = True) -> float:
    """Root mean square length of six errors [m], with body 1's zero as a seventh or without."""
    return float(np.sqrt(np.sum(errors**2) / (7 if base else 6)))


def fit(reading: Reading | None = None, *, start: dict[str, float] | None = None) -> Fit:
    """Fit the lengths to the printed tables.

    Args:
        reading: default the one that the package's tables adopt.
        start: of some unknowns [m], [rad], [1], instead of the rough ones.

    Raises:
        SettingError: single precision, or an unknown name in `start`.
    """
    reading = reading if reading is not None else Reading()
    if jnp.result_type(float) != jnp.float64:
        raise SettingError(
            "The fit needs double precision: call jax.config.update('jax_enable_x64', True) first."
        )
    strange = set(start or {}) - set(UNKNOWNS)
    if strange:
        raise SettingError(f"The fit has no unknown {', '.join(sorted(strange))}.")
    free = reading.free()
    begin = np.array([(start or {}).get(name, at) for name, (at, _) in UNKNOWNS.items()])
    problem = _Problem(
        jnp.asarray(free, dtype=float),
        jnp.asarray(reading.orientations()),
        jnp.asarray(reading.cross == "xy"),
    )
    first = jnp.asarray((begin - _START) / _SIZE * free)
    steps, left, J, good = (np.asarray(x) for x in _minimise(first, problem))
    everything = _START + _SIZE * free * steps
    geometry, angles = mechanism(everything)
    J, names = J[:, free], np.array(list(UNKNOWNS))[free]
    inverse = np.linalg.pinv(J)
    covariance = inverse @ inverse.T
    deviations = np.sqrt(np.diag(covariance))
    of_euler = np.linalg.norm(J[18:34] @ inverse, axis=1)
    return Fit(
        reading=reading,
        converged=bool(good),
        values=dict(zip(names.tolist(), everything[free].tolist(), strict=True)),
        standard_deviations=dict(
            zip(names.tolist(), (deviations * _SIZE[free]).tolist(), strict=True)
        ),
        chi_square=float(left @ left),
        freedom=len(left) - _ALWAYS_ZERO - int(free.sum()),
        correlations=covariance / np.outer(deviations, deviations),
        position_errors=left[:18].reshape(6, 3) * POSITION_DEVIATION,
        euler_errors=left[18:34].reshape(4, 4) * _SPREAD,
        euler_deviations=of_euler.reshape(4, 4) * _SPREAD,
        geometry=geometry,
        angles=np.asarray(angles),
    )


# The choices that were made, each with what else was tried.
ALTERNATIVES: dict[str, Reading] = {
    "adopted reading": Reading(),
    "e1 of p4 as printed": Reading(post="printed"),
    "p7 as printed": Reading(panel="printed"),
    "p7 divided by its norm": Reading(panel="normalised"),
    "joint 3-5 with x in the slider": Reading(cross="xy"),
    "both rods of one length": Reading(design="one rod"),
    "arms apart": Reading(design="arms apart"),
    "panel arms apart": Reading(design="panel arms apart"),
    "depths apart": Reading(design="depths apart"),
    "all of these apart": Reading(design="uneven"),
}


def compare() -> dict[str, Fit]:
    """A fit of every reading in `ALTERNATIVES`."""
    return {name: fit(reading) for name, reading in ALTERNATIVES.items()}


def table(found: Fit) -> str:
    """The fitted unknowns with their standard deviations, and the errors, as text."""
    lines = [f"{'unknown':18s}{'value':>10s}{'deviation':>12s}"]
    for name, value in found.values.items():
        unit = "rad" if name in ("phi", "theta") else "1" if name.startswith("middle") else "mm"
        scale = 1e3 if unit == "mm" else 1.0
        spread = found.standard_deviations[name]
        lines.append(f"{name:18s}{scale * value:10.4f}{scale * spread:12.4f} {unit}")
    lines += ["", f"{'centre of mass':18s}{'fitted less printed [mm]':>30s}"]
    for name, error in zip(TRACKER_BODIES, 1e3 * found.position_errors, strict=True):
        lines.append(f"{name:18s}" + "".join(f"{x:10.3f}" for x in error))
    lines += [
        "",
        f"rms {1e3 * found.rms():.3f} mm over the seven printed centres of mass (body 1 counts as 0),",
        f"{1e3 * found.rms(base=False):.3f} mm over the six that lengths move, "
        f"worst {1e3 * found.worst():.3f} mm",
    ]
    return "\n".join(lines)


def comparison(fits: dict[str, Fit]) -> str:
    """One line for each reading, as text."""
    lines = [
        f"{'reading':32s}{'chi-square':>11s}{'freedom':>9s}{'rms [mm]':>10s}{'worst [mm]':>12s}"
    ]
    for name, found in fits.items():
        note = "" if found.converged else "  not converged"
        lines.append(
            f"{name:32s}{found.chi_square:11.2f}{found.freedom:9d}{1e3 * found.rms():10.3f}"
            f"{1e3 * found.worst():12.3f}{note}"
        )
    return "\n".join(lines)


def main() -> None:
    """Print the fit of the adopted reading and the comparison with the others."""
    with jax.enable_x64(True):
        fits = compare()
        print(table(fits["adopted reading"]), comparison(fits), sep="\n\n")


if __name__ == "__main__":
    main()
