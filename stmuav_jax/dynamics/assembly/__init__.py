"""Consistent initial states, rank of the constraints, and prescribed motion. Floor 6."""
