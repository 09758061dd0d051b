"""Page with the moving mechanism of a run, in three dimensions, for any browser. Floor 14."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
