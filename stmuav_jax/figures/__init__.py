"""Figures, reports, films and pages in 3-D of results."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
