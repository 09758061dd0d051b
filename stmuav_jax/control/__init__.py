"""Closed loops: sampled plants, controllers, runs of both together. Floor 11."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
