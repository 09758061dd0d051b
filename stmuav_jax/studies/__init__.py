"""Monte Carlo: distributions, samples, flights, their store, workers and statistics."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
