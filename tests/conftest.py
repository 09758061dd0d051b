"""Shared set-up of the tests: double precision, shapes checked as the code runs."""

import jax
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)

install_import_hook("stmuav_jax", "beartype.beartype")
