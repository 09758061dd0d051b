"""Flying machines: rotors, motors, battery, wind, sun, tracker, quadrotor, scenes and flying controllers."""

from ..checks.namespace import attach_names

__getattr__, __dir__, __all__ = attach_names(__name__, __file__)
