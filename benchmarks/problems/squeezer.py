"""Andrews' squeezing mechanism: seven bodies, ten revolute joints, three closed loops.

Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), section
VII.7; F. Mazzia and C. Magherini, Test Set for Initial Value Problem Solvers, University of
Bari (2008), problem "Andrews' squeezing mechanism", whose data these are; also problem A03
of the IFToMM library. (The copy of the data in OpenSim's benchmark has point B on the wrong
side and rounded triangle data.)

Bodies and the angle of each from the x axis: the motor's crank K1 at beta from O to P, the
rod K2 at beta + Theta from P back to E, the triangle K3 at gamma from B to E with the
spring's end D, and two dyads from A to E: K5 at delta and K4 at Phi + delta, K7 at epsilon
and K6 at Omega + epsilon. No gravity, a constant torque on K1. From 0 to 0.03 s the crank
turns 2.5 times.
"""

import numpy as np

import stmuav_jax as stm

NAMES: tuple[str, ...] = ("K1", "K2", "K3", "K4", "K5", "K6", "K7")
MASS = (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498)  # kg
INERTIA = (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5)  # kg m^2
A, B, C = (-0.06934, -0.00227), (-0.03635, 0.03273), (0.014, 0.072)  # m, fixed points
STIFFNESS, UNSTRETCHED = 4530.0, 0.07785  # N/m, m
TORQUE = 0.033  # N m

# Lengths [m] and places of the centres of mass, by the source's letters.
D, DA, E, EA, RR, RA = 0.028, 0.0115, 0.02, 0.01421, 0.007, 0.00092
SS, SA, SB, SC, SD = 0.035, 0.01874, 0.01043, 0.018, 0.02
TA, TB, U, UA, UB = 0.02308, 0.00916, 0.04, 0.01228, 0.00449
ZF, ZT, FA = 0.02, 0.04, 0.01421

# beta, Theta, gamma, Phi, delta, Omega, epsilon [rad] at the start, at rest.
START = (
    -0.0617138900142764496358948458001,
    0.0,
    0.455279819163070380255912382449,
    0.222668390165885884674473185609,
    0.487364979543842550225598953530,
    -0.222668390165885884674473185609,
    1.23054744454982119249735015568,
)


def absolute(q: np.ndarray) -> np.ndarray:
    """Angles of K1 to K7 from the x axis, of the seven relative ones (..., 7)."""
    beta, theta, gamma, phi, delta, omega, epsilon = np.moveaxis(np.asarray(q), -1, 0)
    angles = (beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon)
    return np.stack(angles, axis=-1)


def flat(point: tuple[float, float] | np.ndarray) -> np.ndarray:
    """A point of the plane in space."""
    return np.array([*point, 0.0])


def at(place: np.ndarray, angle: float, point: tuple[float, float]) -> np.ndarray:
    """World position of a body's point, the body at `place` and `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return place + np.array([c * point[0] - s * point[1], s * point[0] + c * point[1], 0.0])


def squeezer() -> stm.System:
    """The mechanism at its start, bodies of equal moments of inertia about all axes."""
    angle: dict[str, float] = dict(zip(NAMES, absolute(np.array(START)), strict=True))
    place = {"K1": np.zeros(3), "K3": flat(B), "K5": flat(A), "K7": flat(A)}
    place["K2"] = at(place["K1"], angle["K1"], (RR, 0.0))
    place["K4"] = at(place["K5"], angle["K5"], (ZT, 0.0))
    place["K6"] = at(place["K7"], angle["K7"], (0.0, -U))
    com = {
        "K1": (RA, 0.0), "K2": (-DA, 0.0), "K3": (SB, -SA), "K4": (0.0, -(E - EA)), "K5": (TA, TB),
        "K6": (ZF - FA, 0.0), "K7": (-UB, -UA),
    }  # fmt: skip
    bodies = [
        stm.Body(
            name, mass, 3 * (inertia,), com=flat(com[name]), position=place[name],
            orientation=(np.cos(angle[name] / 2), 0.0, 0.0, np.sin(angle[name] / 2)),
        )
        for name, mass, inertia in zip(NAMES, MASS, INERTIA, strict=True)
    ]  # fmt: skip
    meet = at(place["K2"], angle["K2"], (-D, 0.0))
    ends = {"K3": (0.0, -SS), "K4": (0.0, -E), "K6": (ZF, 0.0)}
    for name, end in ends.items():
        assert np.allclose(at(place[name], angle[name], end), meet, rtol=0, atol=1e-16)
    hinges = {
        "O": ("ground", "K1", place["K1"]), "P": ("K1", "K2", place["K2"]),
        "B": ("ground", "K3", place["K3"]), "A5": ("ground", "K5", place["K5"]),
        "A7": ("ground", "K7", place["K7"]), "G": ("K5", "K4", place["K4"]),
        "H": ("K7", "K6", place["K6"]), **{f"E{name[1]}": ("K2", name, meet) for name in ends},
    }  # fmt: skip
    joints = [
        stm.revolute(name, i, j, point=point, axis=(0.0, 0.0, 1.0))
        for name, (i, j, point) in hinges.items()
    ]
    spring = stm.LinearSpringDamper(
        "ground", "K3", point_i=flat(C), point_j=(SD, -SC, 0.0), stiffness=STIFFNESS,
        length=UNSTRETCHED,
    )  # fmt: skip
    return stm.System(bodies, joints, [stm.AppliedMoment("K1", (0.0, 0.0, TORQUE)), spring])
