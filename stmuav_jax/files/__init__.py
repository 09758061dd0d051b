"""Runs, studies and tables as files: NetCDF, Zarr, TOML. Floor 13."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
