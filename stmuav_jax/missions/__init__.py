"""Missions: closed-loop flights from TOML files, with their verdicts. Floor 15."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
