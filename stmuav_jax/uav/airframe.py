"""Parameter tables of the report's machine: `PART_I` (tracker), `PART_II` (UAV with tracker), `ENERGY`.

The report prints masses, inertia tensors, centres of mass and initial Euler parameters, but
the joints' positions were only in figures that are lost. The lengths here ("geometry.") are
reconstructed: those of a design that is symmetric about the plane y = -x through the post were
fitted to the printed centres of mass (0.64 mm rms) and Euler parameters. Bodies and joints are
made from them and from the panel's initial angles ("posture."); see `geometry.py`. The decisions
and their reasons are in docs/report_machine.md.

Lengths are in the frame of Part I (tracker frame); Part II adds "mount.shift".
"""

from dataclasses import replace

from ..mechanics.parameters import Parameter, Parameters

_FIT = "reconstructed from report Part I, Table 6.1 (docs/report_machine.md)"
_T51 = "report Part II, Table 5.1"
_T52 = "report Part II, Table 5.2"
_T53 = "report Part II, Table 5.3"
_T61 = "report Part I, Table 6.1"
_T62 = "report Part I, Table 6.2"
_CH5 = "report Part I, chapter 5"
_CHOICE = "not in the report; chosen here"


def _inertia_tensor(
    xx: float, yy: float, zz: float, xy: float = 0.0, xz: float = 0.0, yz: float = 0.0
) -> tuple[tuple[float, float, float], ...]:
    """Symmetric inertia tensor from its six entries."""
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


def _list_bodies(
    mass_source: str, inertia_source: str, rows: dict[str, tuple[float, ...]]
) -> dict[str, Parameter]:
    """Masses and inertia tensors of bodies from the rows of a table."""
    parameters = {}
    for name, (mass, *moments) in rows.items():
        parameters[f"mass.{name}"] = Parameter(mass, "kg", mass_source)
        tensor = _inertia_tensor(*moments)
        parameters[f"inertia.{name}"] = Parameter(tensor, "kg m^2", inertia_source)
    return parameters


# fmt: off
# pairs belong to (leg 2, leg 3): slider 2 with rod 6, slider 3 with rod 5
_GEOMETRY = {
    "geometry.axis": Parameter((-0.015, 0.015), "m", _T61 + ": r_6y and r_5, the post's axis"),
    "geometry.hinge": Parameter(0.0632, "m", _FIT),
    "geometry.post": Parameter(0.084, "m", _FIT),
    "geometry.arms": Parameter((0.092, 0.092), "m", _FIT),
    "geometry.panel_arms": Parameter((0.0709, 0.0709), "m", _FIT),
    "geometry.panel_depths": Parameter((0.0145, 0.0145), "m", _FIT),
    "geometry.rods": Parameter((0.095, 0.095), "m", _FIT),
    # slider centres r_2 and r_3 are 108.99 mm from the post's axis and 24.6 mm high
    "geometry.slider_out": Parameter((0.01699, 0.01699), "m", _FIT),
    "geometry.slider_up": Parameter((0.0028, 0.0028), "m", _FIT),
    "geometry.post_com": Parameter((0.0035, 0.0, 0.0361), "m", _FIT),
    "geometry.rod_com": Parameter((0.5, 0.5), "1", _CHOICE + " (the fit's weak prior)"),
    "geometry.panel_com": Parameter((-0.0202, 0.0202, 0.0012), "m", _FIT),
    "posture.phi": Parameter(-0.2674, "rad", _FIT),
    "posture.theta": Parameter(-0.3088, "rad", _FIT),
}

# mass [kg], then xx, yy, zz, xy, xz, yz of the inertia [kg m^2]
_BODIES_I = _list_bodies(_T61, _T62, {
    "base_1": (0.47509, 0.002, 0.002, 0.0026, 0.0008, -0.0001, 0.0001),
    "slider_2": (0.1897, 2.774e-05, 2.0150000000000002e-05, 1.987e-05, 0.0, -1.0200000000000002e-06),
    "slider_3": (0.1897, 2.0150000000000002e-05, 2.774e-05, 1.987e-05, 0.0, 0.0, 1.0200000000000002e-06),
    "post_4": (0.10445, 0.0001217, 0.0001248, 5.400000000000001e-06),
    "rod_5": (0.05325, 5.827e-05, 5.94e-05, 1.72e-06, 0.0, -8.24e-06),
    "rod_6": (0.0544, 6.242e-05, 6.231e-05, 5.8e-07),
    "panel_7": (0.8905, 0.0012, 0.0012, 0.0024, 0.0, 0.0001),
})
# rounded in print: the largest principal moment exceeds the others' sum by 0.7 %
_BODIES_I["inertia.panel_7"] = replace(_BODIES_I["inertia.panel_7"], tolerance=0.008)

_BODIES_II = _list_bodies(_T51, _T53, {
    "hexacopter_1": (5.88295, 0.06245975468000001, 0.06280445983, 0.08929810247, 4.1801e-07, 0.00052075455, 0.00021503033),
    "slider_2": (0.1897, 2.7742820000000003e-05, 2.0147820000000002e-05, 1.9872580000000002e-05, 0.0, -1.01542e-06),
    # yy is printed 27742.83e-9; the mirror of slider_2 and Table 6.2 give this
    "slider_3": (0.1897, 2.0147820000000002e-05, 2.7743240000000002e-05, 1.9872580000000002e-05, 0.0, 0.0, 1.01542e-06),
    "post_4": (0.10445, 0.000121732, 0.00012476270000000002, 5.357600000000001e-06, 1.0000000000000002e-10),
    "rod_5": (0.05325, 5.944735e-05, 5.93967e-05, 5.469500000000001e-07),
    "rod_6": (0.0544, 6.24182e-05, 6.23117e-05, 5.8075e-07, 0.0, 0.0, -5.000000000000001e-11),
    "panel_7": (0.89085, 0.00123305505, 0.0012197628000000002, 0.00243241635, 4.090655e-05, -2.729e-06, -4.355e-07),
})
_BODIES_II["inertia.slider_3"] = replace(
    _BODIES_II["inertia.slider_3"], source=_T53 + ", (1, 1) corrected")

_SPIN = {
    "spin.mass": Parameter(0.1897, "kg", _T61 + ", body 2; drops out of the closed form"),
    "spin.inertia": Parameter(
        (2.774282e-05, 2.014782e-05, 2.075682e-05), "kg m^2",
        "J_zz: report Part I, Eq. 4.28; J_xx, J_yy: Table 5.3, body 2, drop out"),
    "spin.joint": Parameter(
        (0.0, 0.0, -0.05), "m", _CHOICE + " (on the zeta axis; the figure is lost)"),
    "spin.moment": Parameter(1e-4, "N m", "report Part I, Eq. 4.28"),
}

_LOADS_I = {
    "case_1.force": Parameter(4.0, "N", _CH5 + ", case 1"),
    "case_1.angular_frequency": Parameter(12.566370614359172, "rad/s", "4 pi; " + _CH5),
    "case_2.force": Parameter((0.0, 0.0, -3.0), "N", _CH5 + ", case 2"),
    "case_3.moment": Parameter((0.0, 0.1, 0.0), "N m", _CH5 + ", case 3"),
}

_ROTORS = {
    "rotor.k_f": Parameter(6.546e-06, "N s^2/rad^2", _T51),
    "rotor.k_tau": Parameter(1.2864e-07, "N m s^2/rad^2", _T51 + ", unit corrected"),
    # the length of 400 mm in Table 5.1 contradicts these (350 mm) and is not used
    "rotor.arms": Parameter((
        (0.33919, -0.09066, 0.05406), (0.09171, -0.33814, 0.05387), (-0.24637, -0.24756, 0.05362),
        (-0.33695, 0.09052, 0.05335), (-0.08947, 0.33801, 0.05374), (0.24861, 0.24742, 0.05399),
    ), "m", _T52),
    "rotor.spin": Parameter((1.0, -1.0, 1.0, -1.0, 1.0, -1.0), "1", "report Part II, Eq. 4.9"),
}

_FLIGHT = {
    "gravity": Parameter((0.0, 0.0, -9.81), "m/s^2", _CHOICE + " (the report prints no value)"),
    "mount.shift": Parameter(
        (0.05418, -0.05211, 0.03855), "m", "b_1, b_2 of Table 5.2 and docs/report_machine.md"),
    "actuator.axis_2": Parameter((-0.07758, -0.03711, 0.0606), "m", _T52 + ", b_1"),
    "actuator.axis_3": Parameter((0.03918, 0.07938, 0.0657), "m", _T52 + ", b_2"),
    "actuator.force": Parameter(3.0, "N", "report Part II, section 5.2, case 2"),
    "actuator.angular_frequency": Parameter(12.566370614359172, "rad/s", "4 pi; section 5.2"),
    "lift_factor": Parameter(1.2, "1", _CHOICE + " (case 3 prints no thrust)"),
}

_AIR = {
    # plate of about 0.1 m^2 from the side, twice that from below; rotors give the linear part
    "drag.linear": Parameter((0.3, 0.3, 0.2), "N s/m", _CHOICE),
    "drag.quadratic": Parameter((0.06, 0.06, 0.12), "N s^2/m^2", _CHOICE),
    "drag.centre": Parameter((0.0, 0.0, 0.05), "m", _CHOICE + ", near the rotors' plane"),
    "wind.mean": Parameter((5.0, 0.0, 0.0), "m/s", _CHOICE),
    "gust.height": Parameter(20.0, "m", _CHOICE),
    "gust.speed_20ft": Parameter(7.7, "m/s", "MIL-F-8785C, light turbulence: 15 knots"),
    "motor.time_constant": Parameter(0.05, "s", _CHOICE),
    "motor.inertia": Parameter(1e-4, "kg m^2", _CHOICE + ", a rotor of about 0.3 m"),
    "motor.lowest": Parameter(200.0, "rad/s", _CHOICE),
    "motor.highest": Parameter(1900.0, "rad/s", _CHOICE + ", for a thrust of about twice the weight"),
    "gear.spread": Parameter(0.15, "m", _CHOICE),
    "gear.depth": Parameter(0.2, "m", _CHOICE),
    # a start at the origin stands on it, its feet at the depth zero
    "gear.ground": Parameter(-0.2, "m", _CHOICE + ", where the feet touch it at the default start"),
    "gear.stiffness": Parameter(2e4, "N/m", _CHOICE + ", 1.4 mm of deflection under the weight of the UAV"),
    "gear.damping": Parameter(150.0, "N s/m", _CHOICE + ", about 40 % of critical damping"),
    "gear.width": Parameter(1e-3, "m", _CHOICE),
    "gear.friction": Parameter(0.6, "1", _CHOICE),
    "gear.slip_speed": Parameter(0.02, "m/s", _CHOICE),
}

# strokes of (slider 2, slider 3) from the initial posture; |phi|, |theta| <= 45 degrees need
# -15 to 75 and -37 to 103 mm
_DRIVE = {
    "servo.stiffness": Parameter(1e6, "N/m", _CHOICE),
    "servo.damping": Parameter(900.0, "N s/m", _CHOICE),
    "stop.lower": Parameter((-0.012, -0.035), "m", _CHOICE + ", within 45 degrees of panel tilt"),
    "stop.upper": Parameter((0.075, 0.1), "m", _CHOICE + ", within 45 degrees of panel tilt"),
    "stop.stiffness": Parameter(1e5, "N/m", _CHOICE),
    "stop.damping": Parameter(100.0, "N s/m", _CHOICE),
    "stop.width": Parameter(2e-4, "m", _CHOICE),
    "friction.coulomb": Parameter(0.5, "N", _CHOICE),
    "friction.viscous": Parameter(0.0, "N s/m", _CHOICE),
    "friction.speed": Parameter(1e-3, "m/s", _CHOICE),
}

# with the lengths above, strokes determine the posture up to about 65 degrees of tilt
_WORKSPACE = {
    "workspace.tilt": Parameter(1.0471975511965976, "rad", _CHOICE + ", 60 degrees"),
    "workspace.margin": Parameter(0.05, "1", _CHOICE + ", see stmuav_jax/uav/tracker/workspace.py"),
}

_HEXACOPTER = {
    "bare.mass": Parameter(5.407, "kg", "report Part II, section 5.1"),
    # J_zz is printed as 866e-3, which is impossible for a body
    "bare.inertia": Parameter(
        _inertia_tensor(0.0572, 0.0588, 0.0866, 0.000492, -0.000201, 5.6e-06), "kg m^2",
        "report Part II, section 5.1, J_zz corrected"),
    "bare.lift_factor": Parameter(
        1.1, "1", _CHOICE + " (the report says: larger than the weight)"),
}
# fmt: on

_SHARED = {**_GEOMETRY, **_DRIVE, **_WORKSPACE}

PART_I = Parameters("PART_I", {**_BODIES_I, **_LOADS_I, **_SPIN, **_SHARED})

PART_II = Parameters(
    "PART_II", {**_BODIES_II, **_ROTORS, **_FLIGHT, **_AIR, **_HEXACOPTER, **_SHARED}
)

# Centres of mass as printed in Table 6.1 [m], to which the lengths were fitted
# (reconstruction.py); body 1 is at (-0.06393, 0.06393, 0.03041).
PRINTED_CENTRES = {
    "slider_2": (-0.12399, 0.015, 0.0246),
    "slider_3": (-0.015, 0.12399, 0.0246),
    "post_4": (-0.0115, 0.01837, 0.09921),
    "rod_5": (-0.01299, 0.09833, 0.06884),
    "rod_6": (-0.09231, 0.015, 0.06627),
    "panel_7": (-0.03428, 0.04289, 0.13656),
}

# Euler parameters as printed in Table 6.1: they are not unit (|p7| = 0.9974), and e1 of p4 has the
# wrong sign. They are kept to show their effect; no scene starts from them.
PRINTED_ORIENTATIONS = {
    "slider_2": (1.0, 0.0, 0.0, 0.0),
    "slider_3": (1.0, 0.0, 0.0, 0.0),
    "post_4": (0.9987, 0.0517, 0.0, 0.0),
    "rod_5": (0.9955, 0.0906, 0.020001, -0.00398),
    "rod_6": (0.9880, 0.0, 0.1545, 0.0),
    "panel_7": (0.9768, -0.1355, -0.1482, 0.0188),
}

# Rotors' size, motors, battery, cells and air: the report has no battery, no cells and no radius of the rotors.
# What follows from the numbers chosen here, and what does not depend on them: docs/multirotors.md.
# fmt: off
ENERGY = Parameters("ENERGY", {
    "air.density": Parameter(1.225, "kg/m^3", "ISO 2533, standard atmosphere at sea level"),
    "rotor.radius": Parameter(0.15, "m", _CHOICE + ", a diameter of about 0.3 m; adjacent rotors are 0.35 m apart"),
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
    "battery.reserve": Parameter(0.2, "1", _CHOICE + ", fraction of the charge that is not used"),
    # a square plate of the panel's mass and moment J_zz has sides of 0.128 m
    "cells.area": Parameter(0.0169, "m^2", "0.13 m by 0.13 m, after the panel's inertia (report Part II, Table 5.3)"),
    "cells.efficiency": Parameter(0.2, "1", _CHOICE + ", crystalline silicon"),
    "cells.converter_efficiency": Parameter(0.95, "1", _CHOICE + ", maximum power point tracker"),
})
# fmt: on
