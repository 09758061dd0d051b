"""Rotors, motors, drag, allocation of rotor speeds, power and battery. Floor 7."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
