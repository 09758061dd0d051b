"""Simulation of a system: method, run, certificate, evaluation at a state, joint loads. Floor 7."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
