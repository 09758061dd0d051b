"""Floor 1: states, bodies, constraint primitives, joints, forces, systems."""
