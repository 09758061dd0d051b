"""Parameter table `ENERGY`: rotors' size, motors, battery, cells and air, none of them in the report.

The report gives the rotors' thrust and drag torque, and masses; it has no battery, no cells and no radius of
the rotors. The numbers here are chosen, of a size that is usual, and each says so; docs/energy.md says
what follows from them and what does not depend on them.
"""

from .table import Parameter, Parameters

_CHOICE = "not in the report; chosen here"

# fmt: off
ENERGY = Parameters("ENERGY", {
    "air.density": Parameter(1.225, "kg/m^3", "ISO 2533, standard atmosphere at sea level"),
    "rotor.radius": Parameter(0.15, "m", _CHOICE + ", a rotor of about 0.3 m; neighbours are 0.35 m apart"),
    "rotor.efficiency": Parameter(0.8, "1", _CHOICE + ", of motor and its electronics"),
    # actuators that stand still are taken to need nothing
    "other.power": Parameter(10.0, "W", _CHOICE + ", flight computer, sensors, radio"),
    # 22 V and 16 Ah are about 2 kg, taken to be within the bare hexacopter's 5.407 kg
    "battery.capacity": Parameter(57600.0, "C", _CHOICE + ", 16 Ah"),
    "battery.resistance": Parameter(0.015, "ohm", _CHOICE + ", six cells of 2 milliohm and their wires"),
    "battery.state_of_charge": Parameter(
        (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0), "1", _CHOICE + ", of the open-circuit voltages"),
    "battery.open_circuit_voltage": Parameter(
        (19.62, 21.66, 22.14, 22.38, 22.8, 23.22, 24.12, 24.66, 25.2), "V",
        _CHOICE + ", six lithium-polymer cells in series"),
    "battery.reserve": Parameter(0.2, "1", _CHOICE + ", share of the charge that stays"),
    # a square plate of the panel's mass and moment J_zz has sides of 0.128 m
    "cells.area": Parameter(0.0169, "m^2", "0.13 m by 0.13 m, after the panel's inertia (report Part II, Table 5.3)"),
    "cells.efficiency": Parameter(0.2, "1", _CHOICE + ", crystalline silicon"),
    "cells.converter_efficiency": Parameter(0.95, "1", _CHOICE + ", tracker of the maximum power point"),
})
# fmt: on
