"""The tracker's lengths: what follows from them, that the loops close, and what cannot stand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central, np_rotation
from vectors import UNEVEN

from stmuav_jax import PART_I, PART_II, Augmented, ModelError, System, make_scene
from stmuav_jax.mechanics import Parameter, Parameters
from stmuav_jax.uav import TrackerGeometry, tracker_geometry
from stmuav_jax.uav.tracker.bodies import TRACKER_BODIES, place, tracker_bodies, tracker_joints
from stmuav_jax.uav.tracker.geometry import (
    check_closure,
    initial_angles,
    safe_root,
)

# The assembled mechanism to which the lengths were first fitted, frame of Part I [m]; it was
# found by solving the loops, not by the closed form.
CENTRES = {
    "slider_2": (-0.12399, 0.015, 0.02486361528553466),
    "slider_3": (-0.015, 0.12399, 0.024232802219569794),
    "post_4": (-0.0115, 0.019015458663411464, 0.09907598210115556),
    "rod_5": (-0.012796611778260459, 0.09803685411661023, 0.06802740594379275),
    "rod_6": (-0.09256978971462965, 0.015, 0.06731865954714147),
    "panel_7": (-0.03460921762067631, 0.04250553563552974, 0.1365230902354704),
}
EULER = {
    "post_4": (0.998447424263679, -0.055702252927731635, 0.0, 0.0),
    "rod_5": (0.9952208296055652, 0.09474906850274095, 0.023518102204587072, -0.0022390189298188527),
    "rod_6": (0.9881138026382803, 0.0, 0.15372414590986588, 0.0),
    "panel_7": (0.9792856087169373, -0.13171626247600568, -0.15241478421717697, 0.020500153933106842),
}  # fmt: skip
POINTS = {
    "R14": (-0.015, 0.015, 0.0632),
    "R26": (-0.107, 0.015, 0.02206361528553466),
    "U35": (-0.015, 0.107, 0.021432802219569794),
    "U47": (-0.015, 0.02434344952151144, 0.1466787395151542),
    "S57": (-0.010593223556520917, 0.08907370823322044, 0.11462200966801572),
    "S67": (-0.07813957942925931, 0.015, 0.11257370380874829),
}
ROUND_OFF = 1e-15  # [m]: a few additions of numbers below 0.2


def test_the_tables_lengths_give_the_assembled_mechanism():
    for name, body in zip(TRACKER_BODIES, tracker_bodies(PART_I), strict=True):
        assert np.asarray(body.position) == pytest.approx(CENTRES[name], abs=1e-12)
        assert np.asarray(body.orientation) == pytest.approx(
            EULER.get(name, (1, 0, 0, 0)), abs=1e-12
        )
    joints = {joint.name: joint for joint in tracker_joints(PART_I, "ground")}
    for name, point in POINTS.items():
        assert np.asarray(joints[name].point_i) == pytest.approx(point, abs=1e-12)


def test_points_keep_the_lengths():
    """Straight from the joints' places: rods, post, arms, and where the panel carries them."""
    g = tracker_geometry(PART_I.replaced(UNEVEN))
    at = place(g, jnp.array([0.3, -0.2]))
    points = {name: np.asarray(point) for name, point in at.points.items()}
    span = lambda a, b: np.linalg.norm(points[b] - points[a])
    lengths = [span("R26", "S67"), span("U35", "S57"), span("R14", "U47")]
    assert lengths == pytest.approx([*np.asarray(g.rods), float(g.post)], abs=ROUND_OFF)
    R = np_rotation(at.p[5])
    (b2, b3), (h2, h3) = np.asarray(g.panel_arms), np.asarray(g.panel_depths)
    on_panel = lambda name: R.T @ (points[name] - points["U47"])
    assert on_panel("S67") == pytest.approx([-b2, 0, -h2], abs=ROUND_OFF)
    assert on_panel("S57") == pytest.approx([0, b3, -h3], abs=ROUND_OFF)
    (x, y), (a2, a3) = np.asarray(g.axis), np.asarray(g.arms)
    assert points["R26"][:2] == pytest.approx([x - a2, y], abs=ROUND_OFF)
    assert points["U35"][:2] == pytest.approx([x, y + a3], abs=ROUND_OFF)
    # bodies' z axes run from joint to joint
    for k, low, high in ((2, "R14", "U47"), (3, "U35", "S57"), (4, "R26", "S67")):
        along = points[high] - points[low]
        along = along / np.linalg.norm(along)
        assert np_rotation(at.p[k])[:, 2] == pytest.approx(along, abs=1e-14)


def test_other_postures_close_the_same_joints():
    """Joints made at one posture hold at the places computed for others."""
    table = PART_I.replaced(UNEVEN)
    scene = make_scene("tracker", 2, table)
    model = Augmented().prepare(scene.system)
    g = tracker_geometry(table)

    @jax.jit
    @jax.vmap
    def residuals(angles):
        at = place(g, angles)
        state = jax.tree.map(jnp.zeros_like, scene.state0)
        state = type(state)(at.r, at.p, state.v, state.omega)
        eq = model.constraints.equations(jnp.zeros(()), scene.system.kinematics(state))
        return model.constraints.scales() * eq.value

    angles = np.random.default_rng(3).uniform(-0.6, 0.6, (50, 2))
    angles[:, 1] = angles[:, 1].clip(-0.4)
    found = np.asarray(residuals(jnp.asarray(angles)))
    assert found.shape == (50, 34)
    assert np.max(np.abs(found)) < ROUND_OFF


def test_a_changed_length_moves_the_joints():
    longer = make_scene("uav_tracker", 1, PART_II.replaced({"geometry.rods": (0.1, 0.095)}))
    before = make_scene("uav_tracker", 1)
    moved = np.asarray(longer.state0.r - before.state0.r)
    # a longer rod 6 lowers slider 2 and its own middle, and nothing else
    assert moved[1, 2] < -5e-3
    assert np.abs(np.delete(moved, [1, 5], axis=0)).max() < ROUND_OFF


@pytest.mark.slow
def test_gradients_with_respect_to_every_length():
    """Through placing, bodies, joints and `System`, against differences."""
    keys = [key for key in PART_I if key.startswith(("geometry.", "posture."))]
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(6, 7)), rng.normal(size=(8, 6))

    def number(values):
        table = PART_I.replaced(values)
        system = System(tracker_bodies(table), tracker_joints(table, "ground"))
        at, out = system.reference, 0.0
        out += jnp.sum(weights[0] * jnp.concatenate([at.r, at.p], axis=1))
        ends = [jnp.concatenate([j.point_i, j.point_j + j.frame_j[:, 0]]) for j in system.joints]
        return out + jnp.sum(weights[1] * jnp.stack(ends))

    here = {key: jnp.asarray(PART_I.value(key), dtype=float) for key in keys}
    both = jax.jit(jax.value_and_grad(number))
    gradient = both(here)[1]
    direction = {key: jnp.asarray(rng.normal(size=np.shape(here[key]))) for key in keys}
    step = lambda e: both({k: here[k] + e * direction[k] for k in keys})[0]
    slope = sum(float(jnp.sum(gradient[k] * direction[k])) for k in keys)
    # fourth-order differences
    assert slope == pytest.approx(float(central(step, 1e-4)), rel=1e-8)
    for key in keys:
        assert np.any(np.asarray(gradient[key]) != 0), key


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"geometry.rods": (0.005, 0.095)},
            r"Leg 2 .*phi = -15\.\d+, theta = -17\.\d+ degrees.*5 mm long.*span 28\.\d+ mm sideways.*"
            r"arm 92 mm.*longer than 28\.\d+ mm, or its geometry\.arms between 58\.\d+ mm and 68\.\d+ mm",
        ),
        ({"geometry.rods": (0.095, 0.001)}, r"Leg 3 .*rods longer than 18\.\d+ mm\.$"),
        ({"geometry.arms": (0.092, 0.3)}, r"Leg 3 .*arm 300 mm.*between 0 mm and 168\.\d+ mm"),
        ({"geometry.post": 0.005}, r"post to lean 9\.3\d* mm sideways.*only 5 mm.*longer than 9\.3"),
        ({"geometry.post": -0.084}, r"geometry\.post of the tracker must be positive"),
        ({"geometry.rods": (0.095, 0.0)}, r"geometry\.rods .* positive, but it is \[95\.0, 0\.0\] mm"),
    ],
)  # fmt: skip
def test_lengths_that_cannot_stand_say_why(values, words):
    with pytest.raises(ModelError, match=words):
        tracker_bodies(PART_I.replaced(values))


def test_what_the_message_calls_valid_is_valid():
    for arm in (0.0590, 0.0680):
        values = {"geometry.rods": (0.005, 0.095), "geometry.arms": (arm, 0.092)}
        assert len(tracker_bodies(PART_I.replaced(values))) == 6


def test_wrong_shapes_and_numbers_are_refused():
    g = tracker_geometry(PART_I)
    numbers = {name: getattr(g, name) for name in g.__dataclass_fields__}
    with pytest.raises(ModelError, match=r"geometry\.rods of the tracker must have shape \(2,\)"):
        TrackerGeometry(**{**numbers, "rods": 0.095})
    with pytest.raises(ModelError, match=r"geometry\.hinge of the tracker must be finite"):
        TrackerGeometry(**{**numbers, "hinge": float("nan")})
    # past the table's own check
    bad = Parameter(float("nan"), "rad", "a test")
    with pytest.raises(ModelError, match=r"posture\.phi and posture\.theta .* must be finite"):
        initial_angles(Parameters("broken", {**PART_I, "posture.phi": bad}))


def test_nothing_is_checked_inside_a_transformation():
    """Lengths that cannot stand give NaN there, and finite derivatives elsewhere."""
    g = tracker_geometry(PART_I.replaced({"geometry.rods": (0.005, 0.095)}))
    assert not np.any(np.isfinite(jax.jit(place)(g, initial_angles(PART_I)).r[0, 2]))
    jax.jit(lambda x: check_closure(g, x))(initial_angles(PART_I))
    assert float(jax.grad(lambda x: jnp.where(x > 0, safe_root(x), 0.0))(-1.0)) == 0.0
