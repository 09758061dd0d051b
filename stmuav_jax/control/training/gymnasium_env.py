"""Environments as Gymnasium's, if that optional package is installed."""

from typing import Any

from ...checks.errors import SettingError
from .environment import Environment


def gymnasium_env(environment: Environment) -> Any:
    """Environment as a `gymnasium.Env`, whose actions from -1 to 1 span the limits of the inputs.

    Raises:
        SettingError: the package gymnasium is not installed.
    """
    return _classes().SampledEnv(environment)


def gymnasium_vector_env(environment: Environment, count: int) -> Any:
    """Copies of an environment side by side in one compiled program, as a `gymnasium.vector.VectorEnv`.

    An episode that is over begins anew at the next step (`AutoresetMode.NEXT_STEP`).

    Args:
        count: number of copies.

    Raises:
        SettingError: fewer than one copy, or the package gymnasium is not installed.
    """
    if isinstance(count, bool) or count != int(count) or count < 1:
        raise SettingError(f"A vector of environments needs one copy or more, not {count}.")
    return _classes().SampledVectorEnv(environment, int(count))


def _classes() -> Any:
    """Module with Gymnasium's classes."""
    try:
        from . import gymnasium_classes
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        raise SettingError(
            "Environments of Gymnasium need the package gymnasium: pip install 'stmuav-jax[gym]'."
        ) from error
    return gymnasium_classes
