"""Electrical power of a panel's solar cells under a given light."""

import equinox as eqx
from jaxtyping import Array, Float

from ..checks.errors import ModelError, concrete
from ..checks.numbers import floats, nonnegative
from ..checks.shapes import Numbers
from ..parameters.energy import ENERGY
from ..parameters.table import Parameters


class SolarCells(eqx.Module):
    """Solar cells of one panel: P = A eta c E.

    E is the irradiance in the panel's plane, as `Day.irradiance` has it: of the beam, the part by the
    cosine of its incidence, and light of sky and ground. Heat and reflection at the glass are left out.

    Args:
        area: A [m^2].
        efficiency: eta of the cells [1], from 0 to 1.
        converter_efficiency: c of what stands between cells and battery [1], from 0 to 1.

    Raises:
        ModelError: an area below zero, or an efficiency outside 0 to 1.
    """

    area: Float[Array, ""]
    efficiency: Float[Array, ""]
    converter_efficiency: Float[Array, ""]

    def __init__(
        self, area: Numbers, efficiency: Numbers, converter_efficiency: Numbers = 1.0
    ) -> None:
        self.area = nonnegative(area, "The area of the cells", "m^2")
        self.efficiency = _share(efficiency, "The efficiency of the cells")
        self.converter_efficiency = _share(
            converter_efficiency, "The efficiency of the cells' converter"
        )

    @staticmethod
    def of(parameters: Parameters = ENERGY) -> "SolarCells":
        """Cells of a parameter table ("cells.")."""
        return SolarCells(
            parameters.value("cells.area"),
            parameters.value("cells.efficiency"),
            parameters.value("cells.converter_efficiency"),
        )

    def power(self, irradiance: Numbers) -> Float[Array, "*s"]:
        """Electrical power (...) [W] at irradiances in the panel's plane (...) [W/m^2]."""
        return self.area * self.efficiency * self.converter_efficiency * floats(irradiance)


def _share(value: Numbers, what: str) -> Float[Array, ""]:
    found = nonnegative(value, what, "")
    if concrete(found) and float(found) > 1.0:
        raise ModelError(f"{what} must lie within 0 and 1, but it is {float(found):g}.")
    return found
