"""Closed loops: sampled plants, controllers, runs of both together."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
