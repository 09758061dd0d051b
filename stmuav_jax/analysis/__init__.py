"""Trim, linearisation, tuning and identification of any mechanism, and its sensors."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
