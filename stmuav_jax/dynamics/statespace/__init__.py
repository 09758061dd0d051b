"""Independent coordinates and velocities of mechanisms, and the motion in them."""
