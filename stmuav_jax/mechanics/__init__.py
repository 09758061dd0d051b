"""Bodies, joints, states and systems. Floor 2; the force elements are on floor 3."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
