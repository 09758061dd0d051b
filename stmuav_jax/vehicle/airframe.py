"""The numbers of the report's machine: `PART_I` (tracker) and `PART_II` (hexacopter with it).

The report prints masses, inertia tensors, centres of mass and initial Euler parameters, but
the joints' positions were only in figures that are lost. The geometry here is reconstructed:
lengths of a design that is symmetric about the plane y = -x through the post were fitted to
the printed centres of mass (0.64 mm rms) and Euler parameters; the posture below closes
exactly with them. What was decided, and why, is in docs/geometry.md.

Positions, points and axes are in the frame of Part I (tracker frame), at the initial
posture; Part II adds "mount.shift".
"""

from .parameters import Parameter, Parameters

_FIT = "reconstructed from report Part I, Table 6.1 (docs/geometry.md)"
_T51 = "report Part II, Table 5.1"
_T52 = "report Part II, Table 5.2"
_T53 = "report Part II, Table 5.3"
_T61 = "report Part I, Table 6.1"
_T62 = "report Part I, Table 6.2"
_S31 = "report Part II, section 3.1"
_CH5 = "report Part I, chapter 5"
_CHOICE = "not in the report; chosen here"


def _tensor(
    xx: float, yy: float, zz: float, xy: float = 0.0, xz: float = 0.0, yz: float = 0.0
) -> tuple[tuple[float, float, float], ...]:
    """A symmetric inertia tensor from its six entries."""
    return ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))


# fmt: off
_GEOMETRY = {
    "position.slider_2": Parameter((-0.12399, 0.015, 0.02486361528553466), "m", _FIT),
    "orientation.slider_2": Parameter((1.0, 0.0, 0.0, 0.0), "1", _FIT),
    "position.slider_3": Parameter((-0.015, 0.12399, 0.024232802219569794), "m", _FIT),
    "orientation.slider_3": Parameter((1.0, 0.0, 0.0, 0.0), "1", _FIT),
    "position.post_4": Parameter((-0.0115, 0.019015458663411464, 0.09907598210115556), "m", _FIT),
    "orientation.post_4": Parameter(
        (0.998447424263679, -0.055702252927731635, 0.0, -0.0), "1", _FIT),
    "position.rod_5": Parameter(
        (-0.012796611778260459, 0.09803685411661023, 0.06802740594379275), "m", _FIT),
    "orientation.rod_5": Parameter(
        (0.9952208296055652, 0.09474906850274095, 0.023518102204587072, -0.0022390189298188527), "1", _FIT),
    "position.rod_6": Parameter((-0.09256978971462965, 0.015, 0.06731865954714147), "m", _FIT),
    "orientation.rod_6": Parameter((0.9881138026382803, 0.0, 0.15372414590986588, 0.0), "1", _FIT),
    "position.panel_7": Parameter(
        (-0.03460921762067631, 0.04250553563552974, 0.1365230902354704), "m", _FIT),
    "orientation.panel_7": Parameter(
        (0.9792856087169373, -0.13171626247600568, -0.15241478421717697, 0.020500153933106842), "1", _FIT),
    "axis.T12": Parameter((0.0, 0.0, 1.0), "1", _S31),
    "axis.T13": Parameter((0.0, 0.0, 1.0), "1", _S31),
    "point.R14": Parameter((-0.015, 0.015, 0.0632), "m", _FIT),
    "axis.R14": Parameter((1.0, 0.0, 0.0), "1", _S31),
    "point.R26": Parameter((-0.107, 0.015, 0.02206361528553466), "m", _FIT),
    "axis.R26": Parameter((0.0, 1.0, 0.0), "1", _S31),
    "point.U35": Parameter((-0.015, 0.107, 0.021432802219569794), "m", _FIT),
    "axis_i.U35": Parameter((0.0, 1.0, 0.0), "1", _FIT),
    "axis_j.U35": Parameter(
        (0.9988837713258532, 2.4431537045853097e-19, -0.04723570028951592), "1", _FIT),
    "point.U47": Parameter((-0.015, 0.02434344952151144, 0.1466787395151542), "m", _FIT),
    "axis_i.U47": Parameter((1.0, 0.0, 0.0), "1", _FIT),
    "axis_j.U47": Parameter((0.0, 0.9644611397761418, -0.264224733629737), "1", _FIT),
    "point.S57": Parameter(
        (-0.010593223556520917, 0.08907370823322044, 0.11462200966801572), "m", _FIT),
    "point.S67": Parameter((-0.07813957942925931, 0.015, 0.11257370380874829), "m", _FIT),
}

_BODIES_I = {
    "mass.base_1": Parameter(0.47509, "kg", _T61),
    "inertia.base_1": Parameter(
        _tensor(0.002, 0.002, 0.0026, 0.0008, -0.0001, 0.0001), "kg m^2", _T62),
    "mass.slider_2": Parameter(0.1897, "kg", _T61),
    "inertia.slider_2": Parameter(
        _tensor(2.774e-05, 2.0150000000000002e-05, 1.987e-05, 0.0, -1.0200000000000002e-06), "kg m^2", _T62),
    "mass.slider_3": Parameter(0.1897, "kg", _T61),
    "inertia.slider_3": Parameter(
        _tensor(2.0150000000000002e-05, 2.774e-05, 1.987e-05, 0.0, 0.0, 1.0200000000000002e-06), "kg m^2", _T62),
    "mass.post_4": Parameter(0.10445, "kg", _T61),
    "inertia.post_4": Parameter(
        _tensor(0.0001217, 0.0001248, 5.400000000000001e-06), "kg m^2", _T62),
    "mass.rod_5": Parameter(0.05325, "kg", _T61),
    "inertia.rod_5": Parameter(
        _tensor(5.827e-05, 5.94e-05, 1.72e-06, 0.0, -8.24e-06), "kg m^2", _T62),
    "mass.rod_6": Parameter(0.0544, "kg", _T61),
    "inertia.rod_6": Parameter(_tensor(6.242e-05, 6.231e-05, 5.8e-07), "kg m^2", _T62),
    "mass.panel_7": Parameter(0.8905, "kg", _T61),
    # rounded in print: the largest principal moment exceeds the others' sum by 0.7 %
    "inertia.panel_7": Parameter(
        _tensor(0.0012, 0.0012, 0.0024, 0.0, 0.0001), "kg m^2", _T62, tolerance=0.008),
}

_BODIES_II = {
    "mass.hexacopter_1": Parameter(5.88295, "kg", _T51),
    "inertia.hexacopter_1": Parameter(
        _tensor(0.06245975468000001, 0.06280445983, 0.08929810247, 4.1801e-07, 0.00052075455, 0.00021503033), "kg m^2", _T53),
    "mass.slider_2": Parameter(0.1897, "kg", _T51),
    "inertia.slider_2": Parameter(
        _tensor(2.7742820000000003e-05, 2.0147820000000002e-05, 1.9872580000000002e-05, 0.0, -1.01542e-06), "kg m^2", _T53),
    "mass.slider_3": Parameter(0.1897, "kg", _T51),
    # (1, 1) is printed 27742.83e-9; the mirror of slider_2 and Table 6.2 give this
    "inertia.slider_3": Parameter(
        _tensor(2.0147820000000002e-05, 2.7743240000000002e-05, 1.9872580000000002e-05, 0.0, 0.0, 1.01542e-06), "kg m^2", _T53 + ", (1, 1) corrected"),
    "mass.post_4": Parameter(0.10445, "kg", _T51),
    "inertia.post_4": Parameter(
        _tensor(0.000121732, 0.00012476270000000002, 5.357600000000001e-06, 1.0000000000000002e-10), "kg m^2", _T53),
    "mass.rod_5": Parameter(0.05325, "kg", _T51),
    "inertia.rod_5": Parameter(
        _tensor(5.944735e-05, 5.93967e-05, 5.469500000000001e-07), "kg m^2", _T53),
    "mass.rod_6": Parameter(0.0544, "kg", _T51),
    "inertia.rod_6": Parameter(
        _tensor(6.24182e-05, 6.23117e-05, 5.8075e-07, 0.0, 0.0, -5.000000000000001e-11), "kg m^2", _T53),
    "mass.panel_7": Parameter(0.89085, "kg", _T51),
    "inertia.panel_7": Parameter(
        _tensor(0.00123305505, 0.0012197628000000002, 0.00243241635, 4.090655e-05, -2.729e-06, -4.355e-07), "kg m^2", _T53),
}
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
        (0.05418, -0.05211, 0.03855), "m", "b_1, b_2 of Table 5.2 and docs/geometry.md"),
    "actuator.axis_2": Parameter((-0.07758, -0.03711, 0.0606), "m", _T52 + ", b_1"),
    "actuator.axis_3": Parameter((0.03918, 0.07938, 0.0657), "m", _T52 + ", b_2"),
    "actuator.force": Parameter(3.0, "N", "report Part II, section 5.2, case 2"),
    "actuator.angular_frequency": Parameter(12.566370614359172, "rad/s", "4 pi; section 5.2"),
    "lift_factor": Parameter(1.2, "1", _CHOICE + " (case 3 prints no thrust)"),
}

_HEXACOPTER = {
    "bare.mass": Parameter(5.407, "kg", "report Part II, section 5.1"),
    # J_zz is printed as 866e-3, which no body can have
    "bare.inertia": Parameter(
        _tensor(0.0572, 0.0588, 0.0866, 0.000492, -0.000201, 5.6e-06), "kg m^2",
        "report Part II, section 5.1, J_zz corrected"),
    "bare.lift_factor": Parameter(
        1.1, "1", _CHOICE + " (the report says: larger than the weight)"),
}
# fmt: on

PART_I = Parameters("PART_I", {**_BODIES_I, **_GEOMETRY, **_LOADS_I, **_SPIN})

PART_II = Parameters("PART_II", {**_BODIES_II, **_GEOMETRY, **_ROTORS, **_FLIGHT, **_HEXACOPTER})

# As printed in Table 6.1: not unit (|p7| = 0.9974), and e1 of p4 has the wrong sign. Kept to
# show what they do; no scene starts from them.
PRINTED_ORIENTATIONS = {
    "slider_2": (1.0, 0.0, 0.0, 0.0),
    "slider_3": (1.0, 0.0, 0.0, 0.0),
    "post_4": (0.9987, 0.0517, 0.0, 0.0),
    "rod_5": (0.9955, 0.0906, 0.020001, -0.00398),
    "rod_6": (0.9880, 0.0, 0.1545, 0.0),
    "panel_7": (0.9768, -0.1355, -0.1482, 0.0188),
}
