"""Differentiable simulation, estimation and control of mechanisms with closed loops, in JAX.

Conventions (frames, Euler parameters, signs, units): docs/conventions.md.

The root holds what most programs need; everything else is in the sub-namespaces (`mechanics`,
`dynamics`, `flight`, `estimation`, ...). Names are listed in `__init__.pyi` here and in each
folder, and are imported when they are first used.
"""

from .checks import (
    sources as _sources,  # notes the state of the source files before any is imported
)
from .checks.namespace import attach_names

__version__ = "0.3.0"

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
