"""Options that hold the tracker's sliders: what they add, and that physics stays right."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I, Augmented, Method, ModelError, make_scene, simulate
from stmuav_jax.mechanics import EndStop, JointFriction, JointServo
from stmuav_jax.mechanics.joint_states import evaluate_coordinate
from stmuav_jax.uav import Friction, Servo, Stops
from stmuav_jax.uav.tracker.bodies import slider_drive

GROUPS = ("servo.", "stop.", "friction.")


def strokes(scene, states):
    """The sliders' displacements along their joints (k, 2) [m]."""

    def one(state):
        kin = scene.system.kinematics(state)
        return jnp.stack(
            [evaluate_coordinate(kin, kin.joint(j), "displacement").value for j in ("T12", "T13")]
        )

    return np.asarray(jax.vmap(one)(states))


@pytest.mark.parametrize("name", ["tracker", "uav_tracker"])
def test_a_scene_pays_only_for_what_it_uses(name):
    plain = make_scene(name, 1)
    assert not any(key.startswith(GROUPS) for key in plain.parameters)
    assert any("no friction, no stops, no servo" in note for note in plain.notes)
    options = {
        "servo": (Servo(), JointServo, "servo."),
        "stops": (Stops(), EndStop, "stop."),
        "friction": (Friction(), JointFriction, "friction."),
    }
    for option, (value, kind, group) in options.items():
        scene = make_scene(name, 1, **{option: value})
        added = scene.system.forces[len(plain.system.forces) :]
        assert [type(force) for force in added] == [kind, kind]
        assert [str(force.acts_on()) for force in added] == ["T12", "T13"]
        kept = {k for k in scene.parameters if k.startswith(GROUPS)}
        assert kept
        assert all(key.startswith(group) for key in kept)
        assert any(option in note for note in scene.notes)


def test_numbers_given_are_kept_with_the_results():
    scene = make_scene(
        "tracker", 1, servo=Servo(1e7, 6e4), stops=Stops(lower=-0.01, upper=(0.05, 0.06))
    )
    lines = scene.parameters
    assert lines["servo.stiffness"]["value"] == 1e7
    assert lines["servo.stiffness"]["source"] == "given by the user"
    assert lines["stop.lower"]["value"] == [-0.01, -0.01]
    assert lines["stop.upper"]["value"] == [0.05, 0.06]
    assert lines["stop.width"] == PART_I.to_dict()["stop.width"]
    limits = [(f.lower, f.upper) for f in scene.system.forces if isinstance(f, EndStop)]
    assert np.array(limits).tolist() == [[-0.01, 0.05], [-0.01, 0.06]]


def test_numbers_come_from_the_table_otherwise():
    table = PART_I.replaced({"servo.stiffness": 5e5})
    forces = make_scene("tracker", 1, table, servo=Servo(damping=7.0)).system.forces
    servos = [f for f in forces if isinstance(f, JointServo)]
    assert [(float(f.stiffness), float(f.damping)) for f in servos] == 2 * [(5e5, 7.0)]


def rise(t):
    """A target that goes from 0 to 8 mm in 0.1 s and back."""
    return 0.004 * (1 - jnp.cos(jnp.pi * t / 0.1))


@pytest.fixture(scope="module")
def flown():
    """UAV, case 2, with everything: a servo pushes slider 2 into a stop at 5 mm, one holds slider 3."""
    scene = make_scene(
        "uav_tracker",
        2,
        servo=Servo(2e4, 50.0, targets=(rise, 0.0)),
        stops=Stops(upper=(0.005, 0.1)),
        friction=Friction(speed=0.01),
    )
    return simulate(
        scene,
        method=Method(rtol=1e-10, atol=1e-10, formulation=Augmented()),
        t1=0.12,
        save_every=0.005,
    )


@pytest.mark.slow
def test_a_servo_holds_its_slider_and_a_stop_stops_one(flown):
    """Slider 3 stays within what the case's 3 N and the links bend 2e4 N/m by."""
    x = strokes(flown.scene, flown.states)
    assert np.max(np.abs(x[:, 1])) < 2e-3
    # spring of the stop against spring of the servo, 3 mm apart
    assert 0.005 < np.max(x[:, 0]) < 0.005 + 0.003 * 2e4 / 1e5 + 5e-4
    assert np.max(x[:5, 0]) < 0.002


@pytest.mark.slow
def test_balances_close_with_everything_in_the_sliders(flown):
    """The pairs are internal: momentum changes by gravity and rotors alone."""
    certificate = flown.certificate
    assert certificate.relative_energy_error < 1e-8
    assert certificate.momentum_error < 1e-10
    assert certificate.angular_momentum_error < 1e-10


def test_a_servo_follows_given_targets():
    scene = make_scene("tracker", 2, servo=Servo(targets=(lambda t: 0.01 * t, 0.002)))
    first, second = (f for f in scene.system.forces if isinstance(f, JointServo))
    assert [float(x) for x in first.reference(jnp.asarray(2.0))] == [0.02, 0.01]
    assert [float(x) for x in second.reference(jnp.asarray(2.0))] == [0.002, 0.0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"servo": Servo(stiffness=-1.0)}, "stiffness of the servo in joint 'T12'.* negative"),
        ({"stops": Stops(lower=(0.0, 0.1, 0.2))}, r"'stop\.lower' must have shape \(2,\)"),
        ({"friction": Friction(speed=0.0)}, "speed of the friction in joint 'T12'.* positive"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(ModelError, match=words):
        make_scene("tracker", 1, **options)


def test_a_servo_needs_two_targets():
    servo = Servo()
    # past the type check that the tests switch on
    object.__setattr__(servo, "targets", (0.0,))
    with pytest.raises(ModelError, match=r"must be two, for the sliders of T12 and T13.* are 1"):
        slider_drive(PART_I, servo=servo)
