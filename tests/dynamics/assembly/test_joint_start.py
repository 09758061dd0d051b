"""States from joint coordinates and rates: open chains of every joint, and closed loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.dynamics.assembly.closing import with_drivers

Y = np.array([0.0, 1.0, 0.0])


def body(name, **more):
    return stm.Body(name, 1.0, [0.1, 0.12, 0.14], com=[0.05, -0.1, 0.02], **more)


@pytest.fixture(scope="module")
def chain():
    """Joints with one to three coordinates, written from the root outwards and inwards."""
    joints = [
        stm.revolute("R", "ground", "a", point=[0.1, 0, 0], axis=[1.0, 2, 2]),
        stm.universal("U", "a", "b", point=[0.3, 0.2, 0], axis_i=[1.0, 1, 0], axis_j=[1.0, -1, 1]),
        stm.cylindrical("C", "c", "b", point=[0, 0.5, 0.1], axis=[0.0, 1, 3]),
        stm.spherical("S", "d", "c", point=[0.7, 0, 0.4]),
        stm.universal("V", "e", "d", point=[0.9, 0, 0], axis_i=[0.0, 1, 0], axis_j=[1.0, 0, 1]),
        stm.weld("W", "f", "e", point=[0.1, 0.1, 0.1]),
        stm.screw("H", "f", "g", point=[0.2, 0.3, 0.1], axis=[1.0, 0, 1], pitch=0.05),
    ]
    return stm.System([body(name) for name in "abcdefg"], joints)


Q = {"R": 0.7, "U": [0.4, -1.1], "C": [0.3, 2.2], "S": [0.5, -0.3, 0.8], "V": [-0.6, 0.9], "H": 9.5}
U = {
    "R": -1.3,
    "U": [0.7, 2.0],
    "C": [-0.5, 0.9],
    "S": [1.0, 0.4, -0.6],
    "V": [0.2, -1.6],
    "H": 1.2,
}


def misfit(system, state, t=0.0):
    """Largest misfit of positions and of velocities."""

    @jax.jit
    def off(state):
        eq = (
            stm.Augmented()
            .prepare(system)
            .constraints.equations(jnp.asarray(t), system.kinematics(state))
        )
        now = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        return jnp.max(jnp.abs(eq.value)), jnp.max(jnp.abs(eq.matrix @ now - eq.target))

    return tuple(map(float, off(state)))


@pytest.mark.slow
def test_an_open_chain_takes_all_coordinates_and_rates(chain):
    state = stm.state_from_joints(chain, Q, U)
    assert max(misfit(chain, state)) < 3e-15
    for name in Q:
        found = stm.mechanics.joint_motion(chain, state, name)
        np.testing.assert_allclose(found.coordinates, np.atleast_1d(Q[name]), atol=5e-15)
        np.testing.assert_allclose(found.rates, np.atleast_1d(U[name]), atol=1e-14)


@pytest.mark.slow
def test_the_rows_that_hold_coordinates_of_closed_loops_say_the_same(chain):
    state = stm.state_from_joints(chain, Q, U)
    given, rates = (
        {name: jnp.atleast_1d(jnp.asarray(x)) for name, x in values.items()} for values in (Q, U)
    )
    assert max(misfit(with_drivers(chain, given, rates, jnp.zeros(())), state)) < 1e-14


@pytest.mark.slow
def test_what_is_not_named_stays_as_at_the_start(chain):
    """A base that floats moves on, and joints keep their coordinates and rates."""
    floating = stm.System([body("a", free=True), body("b"), body("c")], [
        stm.revolute("R", "b", "a", point=[0.1, 0, 0], axis=[1.0, 2, 2]),
        stm.revolute("P", "b", "c", point=[0.3, 0, 0.1], axis=[0.0, 0, 1]),
    ])  # fmt: skip
    rest = floating.reference
    pushed = stm.State(rest.r + 1.0, rest.p, rest.v + jnp.array([0.3, 0, 0]), rest.omega)
    first = stm.state_from_joints(floating, {"R": 0.4}, {"R": 1.0}, start=pushed)
    second = stm.state_from_joints(floating, {"P": -2.0}, start=first)
    assert max(misfit(floating, second)) < 1e-15
    hinge, pivot = (stm.mechanics.joint_motion(floating, second, name) for name in "RP")
    assert float(hinge.angle) == pytest.approx(0.4)
    assert float(hinge.angle_rate) == pytest.approx(1.0)
    assert float(pivot.angle) == pytest.approx(-2.0)
    np.testing.assert_allclose(second.v[0], [0.3, 0, 0], atol=1e-15)


# --- a four-bar linkage: a parallelogram, whose angles are known


PIN_D = np.array([2.0, 0, 0])


def four_bar(b=(0.0, 0, 1), c=(2.0, 0, 1)):
    """Four-bar of given pins B and C, by default a parallelogram upright at reference; angles about y."""
    b, c = np.array(b), np.array(c)
    bar = lambda name, one, two: stm.Body(name, 1.0, [0.1, 0.1, 0.01], position=(one + two) / 2)
    joints = [
        stm.revolute("A", "ground", "crank", point=np.zeros(3), axis=Y),
        stm.revolute("B", "crank", "coupler", point=b, axis=Y),
        stm.revolute("C", "coupler", "rocker", point=c, axis=Y),
        # a ball, so that no row of the plane loop is dependent
        stm.spherical("D", "ground", "rocker", point=PIN_D),
    ]
    bodies = [bar("crank", np.zeros(3), b), bar("coupler", b, c), bar("rocker", PIN_D, c)]
    return stm.System(bodies, joints)


@pytest.fixture(scope="module")
def linkage():
    return four_bar()


@pytest.mark.slow
def test_a_closed_loop_is_assembled_with_what_is_given(linkage):
    state = stm.state_from_joints(linkage, {"A": 0.5}, {"B": 1.5})
    assert max(misfit(linkage, state)) < 1e-11
    angle = lambda name: stm.mechanics.joint_motion(linkage, state, name)
    assert float(angle("A").angle) == pytest.approx(0.5, abs=1e-11)
    # coupler parallel to the ground: it turns back against the crank, which goes the other way
    assert float(angle("B").angle) == pytest.approx(-0.5, abs=1e-11)
    assert float(angle("B").angle_rate) == pytest.approx(1.5, abs=1e-11)
    assert float(angle("A").angle_rate) == pytest.approx(-1.5, abs=1e-11)
    np.testing.assert_allclose(angle("D").coordinates, [0, 0.5, 0], atol=1e-11)


@pytest.mark.slow
def test_contradictions_are_refused_in_words(linkage):
    with pytest.raises(stm.StateError, match=r"No posture with A = 0.5, B = 0.2 was found"):
        stm.state_from_joints(linkage, {"A": 0.5, "B": 0.2})
    with pytest.raises(
        stm.StateError, match=r"joint rates A = 1, B = 1 are inconsistent in this posture"
    ):
        stm.state_from_joints(linkage, {"A": 0.5}, {"A": 1.0, "B": 1.0})


def crank_rocker_pins(turn):
    """Pins B and C of a crank-rocker (0.75, 2.25, 1.75, base 2 m), C above the line from B to D."""
    b = 0.75 * np.array([np.sin(turn), 0, np.cos(turn)])
    apart = PIN_D - b
    length = np.linalg.norm(apart)
    along = (2.25**2 - 1.75**2 + length**2) / (2 * length)
    up = np.array([-apart[2], 0, apart[0]]) / length
    return b, b + along * apart / length + np.sqrt(2.25**2 - along**2) * up


@pytest.mark.slow
def test_a_closed_loop_keeps_its_branch():
    """A crank-rocker, one branch of which is out of reach of the other, against its geometry."""
    bars = four_bar(*crank_rocker_pins(0.0))
    for turn in (-2.5, -1.2, 0.6, 1.8, 3.0):
        state = stm.state_from_joints(bars, {"A": turn})
        middles = [(PIN_D + crank_rocker_pins(turn)[1]) / 2, crank_rocker_pins(turn)[0] / 2]
        np.testing.assert_allclose(state.r[np.array([2, 0])], middles, atol=1e-9)
        # from there on, the shorter way round
        back = stm.state_from_joints(bars, {"A": turn + 4.0}, start=state)
        pins = crank_rocker_pins(turn + 4.0)
        np.testing.assert_allclose(back.r[2], (PIN_D + pins[1]) / 2, atol=1e-9)
    # coordinates that say more than the freedoms are no way, but a place
    turned = lambda name: stm.mechanics.joint_motion(bars, state, name).angle
    both = stm.state_from_joints(bars, {"A": turned("A"), "B": turned("B")})
    np.testing.assert_allclose(both.r, state.r, atol=1e-9)
    # on the other branch alone, behind postures where coupler and rocker are in line
    with pytest.raises(stm.StateError, match="do not stay closed between the start and C = 2"):
        stm.state_from_joints(bars, {"C": 2.0})


@pytest.mark.slow
def test_derivatives_through_a_closed_loop(linkage):
    """Of the coupler's place by the crank's angle, and of a rate by another."""
    place = lambda x: stm.state_from_joints(linkage, {"A": x}, {"B": -x}).r[1]
    J = jax.jit(jax.jacfwd(place))(0.5)
    np.testing.assert_allclose(J, [np.cos(0.5), 0, -np.sin(0.5)], atol=1e-9)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"R": [0.1, 0.2]},
            r"coordinate of joint 'R' \(revolute\) must be 1 number \(angle \[rad\]\)",
        ),
        ({"W": 0.1}, "weld joint, which has no joint coordinates"),
        ({"R": np.nan}, "coordinate of joint 'R' must be finite"),
    ],
)
def test_words_of_refusals(chain, given, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.state_from_joints(chain, given)


def test_drivers_are_not_given():
    hinge = stm.revolute("A", "ground", "a", point=[0.0, 0, 0], axis=Y)
    motor = stm.drive("M", hinge, lambda t: t, coordinate="angle")
    with pytest.raises(stm.ModelError, match="'M' is a driver, whose rate is prescribed"):
        stm.state_from_joints(stm.System([body("a")], [hinge, motor]), rates={"M": 1.0})
