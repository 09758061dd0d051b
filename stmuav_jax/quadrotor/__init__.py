"""Part III of the report: the quadrotor's models, its eight cases, their assessment. Floor 9."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
