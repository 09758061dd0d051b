"""Consistent initial states, rank of the constraints, and prescribed motion."""
