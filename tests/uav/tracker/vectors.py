"""The tracker's equations in NumPy's vectors, and one of uneven lengths."""

import numpy as np
from helpers import np_rotation, turn

UNEVEN = {
    "geometry.arms": (0.094, 0.089),
    "geometry.panel_arms": (0.069, 0.073),
    "geometry.panel_depths": (0.013, 0.016),
    "geometry.rods": (0.093, 0.098),
    "geometry.rod_com": (0.4, 0.55),
    "geometry.panel_com": (0.002, -0.003, 0.004),
}


def np_panel(angles):
    """R_x(phi) R_y(theta)."""
    phi, theta = angles
    return np_rotation(turn([1, 0, 0], phi)) @ np_rotation(turn([0, 1, 0], theta))


def np_strokes(g, angles, signs=(1.0, 1.0)):
    """Report Part II, Eq. 3.9 in vectors, corrected, with the hinge as origin."""
    R = np_panel(angles)
    (a2, a3), (b2, b3), (h2, h3) = map(np.asarray, (g.arms, g.panel_arms, g.panel_depths))
    low = np.array([[-a2, 0, 0], [0, a3, 0]])
    arms = np.array([[-b2, 0, -h2], [0, b3, -h3]]) @ R.T
    sine = arms[0, 1] / float(g.post)
    t = float(g.post) * np.array([0, -sine, np.sqrt(1 - sine**2)]) - low + arms
    root = np.sqrt(np.asarray(g.rods) ** 2 + t[:, 2] ** 2 - np.sum(t * t, axis=1))
    return float(g.hinge) + t[:, 2] - np.asarray(signs) * root
