"""Simulation of a system: method, run, certificate, evaluation at a state, joint loads."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
