"""Instruments and outputs that do not see a mode are refused, and the mode is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_motion_estimator import instruments

import stmuav_jax as stm

control, sensing = stm.control, stm.analysis

RATE, LATE = 400.0, 0.02
NAMES = (("x", "m"), ("v", "m/s"), ("e", "m"))


def measured(*rows):
    """Mass on a rail, beside a mode that decays, with measured combinations of their states."""
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, -2.0]])
    C = np.array(rows)
    inputs, outputs = (("u", "N"),), tuple((f"y{k}", "") for k in range(len(C)))
    return stm.analysis.Linear(A, np.ones((3, 1)), C, np.zeros((len(C), 1)), NAMES, inputs, outputs)


def test_a_mode_that_the_outputs_do_not_see_is_named():
    """A place cannot be told from its rate; a mode that decays need not be seen."""
    control.check_observable(measured([1.0, 0.0, 0.0]))
    control.check_observable(measured([1e-3, 1.0, 0.0]))
    with pytest.raises(stm.ModelError, match=r"do not observe the mode .* in x \(100%\): they do"):
        control.check_observable(measured([0.0, 1.0, 1.0]))
    with pytest.raises(stm.ModelError, match=r"x \(100%\)"):
        control.check_observable(measured([0.0, 0.0, 1.0]))


def unseen(fixes):
    """States in all that fixes do not see at rest, by the rows H A^k of rates of errors by hand."""
    A, one = np.zeros((5, 5, 3, 3)), np.eye(3)
    felt = np.array([[0.0, -9.81, 0.0], [9.81, 0.0, 0.0], [0.0, 0.0, 0.0]])
    # attitude by the gyroscope's bias, position by velocity, velocity by attitude and bias
    A[0, 3], A[1, 2], A[2, 0], A[2, 4] = -one, one, -felt, -one
    A = A.transpose(0, 2, 1, 3).reshape(15, 15)
    rows = {"position": [0, 1, -LATE, 0, 0], "attitude": [1, 0, 0, 0.01, 0]}
    H = np.vstack([np.kron(rows[fix], one) for fix in fixes])
    rows_all = np.vstack([H @ np.linalg.matrix_power(A, k) for k in range(4)])
    _, values, right = np.linalg.svd(rows_all)
    null = right[np.sum(values > 1e-9) :]
    names = [f"{n} {axis}" for n in ("attitude", "position", "velocity", "gyroscope bias",
             "accelerometer bias") for axis in "xyz"]  # fmt: skip
    return {names[k] for k in np.flatnonzero(np.sum(null**2, axis=0) > 1e-6)}


def test_fixes_that_do_not_see_the_state_are_refused():
    """What is named is of what the rows by hand do not see; with both fixes they see everything."""
    scene, name = stm.make_scene("hexacopter"), "hexacopter"
    good = instruments(name)
    assert unseen(["position", "attitude"]) == set()
    stm.uav.MotionEstimator(scene.system, RATE, good)
    for left_out, fix, alone in ((2, "attitude", "position"), (3, "position", "attitude")):
        few = [one for k, one in enumerate(good) if k != left_out]
        with pytest.raises(stm.SettingError, match=rf"there is no '{alone} hexacopter'") as error:
            stm.uav.MotionEstimator(scene.system, RATE, few)
        words = str(error.value).split(" in ")[1].split(":")[0]
        named = {part.split(" (")[0].strip() for part in words.split("), ")}
        assert named <= unseen([fix])
        wanted = {f"{alone} {axis}" for axis in ("xyz" if alone == "position" else "z")}
        assert wanted <= named


def test_a_panel_that_one_encoder_watches_is_refused():
    table = stm.PART_II
    system = stm.make_scene("uav_tracker", 2).system
    bodies = stm.uav.panel_bodies(
        system, stm.uav.tracker_geometry(table), table.value("mount.shift")
    )
    encoders = [control.Instrument(sensing.Encoder(j), noise=1e-5) for j in ("T12", "T13")]
    good = instruments(system.names[0])
    stm.uav.MotionEstimator(system, RATE, good + encoders, tracker=bodies)
    strokes = lambda x: stm.uav.strokes(bodies.geometry, x)
    J = jax.jacfwd(strokes)(stm.uav.panel_motion(system.reference).value)
    # the turn that leaves the first stroke as it is
    still = np.array([J[0, 1], -J[0, 0]])
    share = still[0] ** 2 / np.sum(still**2)
    words = rf"there is no 'encoder T13'.* in phi \({share:.0%}\)"
    with pytest.raises(stm.SettingError, match=words):
        stm.uav.MotionEstimator(system, RATE, [*good, encoders[0]], tracker=bodies)


def test_an_estimator_may_be_made_inside_a_compiled_function():
    scene = stm.make_scene("hexacopter")

    def started(r):
        estimator = stm.uav.MotionEstimator(scene.system, RATE, instruments("hexacopter"))
        state = scene.state0
        return estimator.start(stm.State(r[None], state.p, state.v, state.omega)).base.mean["r"]

    r = jnp.array([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(jax.jit(started)(r), r)
