"""Differentiable simulation, estimation and control of mechanisms with closed loops, in JAX.

Conventions (frames, Euler parameters, signs, units): docs/conventions.md.

The root holds what most programs need; everything else is in the sub-namespaces (`mechanics`,
`dynamics`, `flight`, `estimation`, ...). Names are listed in `__init__.pyi` here and in each
folder, and are imported when they are first used: the command line answers `--help` without JAX.
"""

import lazy_loader

__version__ = "0.2.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
