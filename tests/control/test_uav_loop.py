"""The UAV with its tracker under control: the report's three cases, and what its servo knows."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.compiler import quick_jit

control, tracker = stm.control, stm.tracker

TABLE = stm.PART_II
LOWEST, HIGHEST = 200.0, 1900.0
HOME = tracker.initial_angles(TABLE)
# the panel's slew of case 2 and 3 [rad], and its time [s]
GOAL, SLEW = jnp.array([0.25, 0.2]), 1.0


class Mission(eqx.Module):
    """Reference: the base climbs with an acceleration [m/s^2], the panel turns by a share of a slew."""

    climb: jax.Array
    share: jax.Array

    def __call__(self, t):
        f = lambda t: 0.5 * self.climb * t**2
        rise = lambda s: s**3 * (10 - 15 * s + 6 * s**2)
        angle = lambda t: HOME + self.share * (GOAL - HOME) * rise(jnp.clip(t / SLEW, 0, 1))
        rate = lambda g: lambda t: jax.jvp(g, (t,), (jnp.ones_like(t),))[1]
        up = lambda x: jnp.array([0.0, 0.0, 1.0]) * x
        zero = jnp.zeros(3)
        base = control.Waypoint(
            up(f(t)), up(self.climb * t), up(self.climb), zero, zero, *jnp.zeros(3)
        )
        panel = tracker.PairMotion(angle(t), rate(angle)(t), rate(rate(angle))(t))
        return control.UavReference(base, panel)


def uav(push):
    """The UAV with the report's actuator forces of an amplitude [N] as disturbances, and a pilot."""
    scene = stm.make_scene("uav_tracker", 2)
    sine = stm.mechanics.Sine(jnp.asarray(push), TABLE.value("actuator.angular_frequency"))
    own = [f for f in scene.system.forces if isinstance(f, tracker.LinearActuator)]
    disturbed = [eqx.tree_at(lambda f: f.force, f, sine) for f in own]
    system = eqx.tree_at(lambda s: s.forces, scene.system, (*scene.system.forces, *disturbed))
    hover = float(jnp.sum(system.bodies.mass)) * 9.81 / 6 / TABLE.value("rotor.k_f")
    names = ["speed_squared", "force_slider_2", "force_slider_3"]
    plant = control.Plant(
        system, scene.state0, inputs=names, before=jnp.array([hover] * 6 + [0.0] * 2)
    )
    limits = stm.rotorcraft.RotorLimits(LOWEST, HIGHEST)
    bodies = control.panel_bodies(
        plant.system, tracker.tracker_geometry(TABLE), TABLE.value("mount.shift")
    )
    pilot = control.UavController(
        plant.system,
        control.FlightController(plant.system, plant.rate, limits=limits),
        control.PanelServo(bodies),
    )
    return plant, pilot


SIGNALS = {
    "wanted": lambda s: s.reference.panel.value,
    "panel": lambda s: control.panel_motion(s.state).value,
    "height": lambda s: s.reference.waypoint.r[2],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("push", "climb", "share"),
    [(0.0, 0.0, 0.0), (3.0, 0.0, 1.0), (3.0, 1.962, 1.0)],
    ids=["case 1", "case 2", "case 3"],
)
def test_the_reports_cases_with_the_loop_closed(push, climb, share):
    """Position within 5 cm, tilt within 2 degrees, panel within 0.4 degrees, all limits kept."""
    plant, pilot = uav(push)
    mission = Mission(jnp.asarray(climb), jnp.asarray(share))
    run = control.close_loop(
        plant, pilot, 4.0, reference=mission, memory=pilot.start(), signals=SIGNALS
    )
    base = run.body("hexacopter_1")
    off = base.r - np.stack([0 * run.ts, 0 * run.ts, run.signal("height")], axis=1)
    assert np.max(np.linalg.norm(off, axis=1)) < 0.05
    tilt = 2 * np.degrees(np.arcsin(np.hypot(base.p[:, 1], base.p[:, 2])))
    assert np.max(tilt) < 2.0
    panel = np.degrees(np.abs(run.signal("panel") - run.signal("wanted")))
    assert np.max(panel) < 0.4
    squared = run.input("speed_squared")
    assert np.all((squared > LOWEST**2) & (squared < HIGHEST**2))
    limits = tracker.tracker_limits(TABLE)
    strokes = jax.vmap(lambda x: tracker.strokes(tracker.tracker_geometry(TABLE), x))
    shifts = np.asarray(strokes(jnp.asarray(run.signal("panel")))) - limits.home
    assert np.all((shifts > limits.lower) & (shifts < limits.upper))
    assert run.certificate.position_violation < 1e-9
    assert run.certificate.relative_energy_error < 1e-6


def test_the_servo_knows_the_trackers_equations():
    """Its forces, on a base of 1e9 kg that is held, give the accelerations they were found for."""
    heavy = {"mass.hexacopter_1": 1e9, "inertia.hexacopter_1": 1e9 * np.eye(3)}
    flyer = stm.scenes.uav_flyer(TABLE.replaced(heavy))
    bodies = control.panel_bodies(
        flyer.system, tracker.tracker_geometry(TABLE), TABLE.value("mount.shift")
    )
    angles, rates = jnp.array([0.1, -0.2]), jnp.array([0.7, -0.4])
    wanted = jnp.array([3.0, -5.0])
    motion = tracker.PairMotion(angles, rates, wanted)
    found = control.inverse_dynamics(bodies, motion, jnp.array([0.0, 0.0, -9.81]), jnp.zeros(3))
    zero = jnp.zeros(3)
    at = stm.flight.FlyerPoint(zero, jnp.array([1.0, 0, 0, 0]), angles, zero, zero, rates)
    held = stm.AppliedForce("hexacopter_1", jnp.array([0.0, 0.0, 9.81e9]))
    idle = stm.inputs_of(flyer.system).applied(
        flyer.system, jnp.concatenate([jnp.zeros(6), found.forces])
    )
    system = eqx.tree_at(lambda s: s.forces, idle, (*idle.forces, held))
    rate = quick_jit(lambda x, s: flyer.rates(x, 0.0, s))(at, system)
    # the base gives way by some 20 N / 1e9 kg
    np.testing.assert_allclose(rate[14:16], wanted, rtol=1e-6)
    assert np.max(np.abs(rate[8:14])) < 1e-6
