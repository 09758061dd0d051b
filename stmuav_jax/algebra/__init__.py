"""Floor 0: rotations by Euler parameters, and the linear solves of constrained dynamics."""
