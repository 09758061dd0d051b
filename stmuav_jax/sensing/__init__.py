"""Sensors on a mechanism, and the simulator as a filter's process model. Floor 8."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
