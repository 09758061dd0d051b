"""State estimation for any model: sigma-point filters, smoother, consistency."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
