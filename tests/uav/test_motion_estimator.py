"""The estimator of a machine's motion: its consistency, its equations, and what it refuses."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial import transform

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.math.space import Composite, Rotation, Vector
from stmuav_jax.mechanics.state import State

control, sensing = stm.control, stm.analysis
Instrument = control.Instrument

RATE, DEGREE = 400.0, np.pi / 180
# a common inertial unit: 0.005 degrees/s/sqrt(Hz) and 100 micro-g/sqrt(Hz)
TURNING, FORCE = 0.005 * DEGREE * np.sqrt(RATE), 100e-6 * 9.81 * np.sqrt(RATE)
SPACE = Composite(
    p=Rotation(), r=Vector(3), v=Vector(3), gyroscope_bias=Vector(3), accelerometer_bias=Vector(3)
)


def instruments(body, gyroscope_bias=None, accelerometer_bias=None):
    """Inertial unit, a position to 1 cm at 50 Hz and an attitude to 0.5 degrees at 100 Hz, both late."""
    return [
        Instrument(sensing.Gyroscope(body), noise=TURNING, bias=gyroscope_bias),
        Instrument(sensing.Accelerometer(body), noise=FORCE, bias=accelerometer_bias),
        Instrument(sensing.PositionFix(body), rate=50.0, noise=0.01, delay=0.02),
        Instrument(sensing.AttitudeFix(body), rate=100.0, noise=0.5 * DEGREE, delay=0.01),
    ]


SEEDS, SECONDS = 100, 4.0
NOISES = {"gyroscope": 0.01, "accelerometer": 0.1, "position": 0.01, "attitude": 0.01}


@functools.cache
def truth(rate):
    """Rigid motion that turns at about a rate [rad/s], by SciPy: attitudes (k, 4), motion, readings."""
    t = np.arange(int(SECONDS * RATE) + 1) / RATE
    omega = lambda t: (
        rate * np.array([np.sin(1.3 * t + 0.4), 0.7 * np.cos(0.9 * t), 0.6 * np.sin(0.5 * t) + 0.3])
    )

    def slope(t, p):
        e, w = p[1:], omega(t)
        return 0.5 * np.concatenate([[-e @ w], p[0] * w + np.cross(e, w)])

    p0 = [1.0, 0.0, 0.0, 0.0]
    p = solve_ivp(slope, (0, t[-1]), p0, "DOP853", t_eval=t, rtol=1e-11, atol=1e-12).y.T
    p /= np.linalg.norm(p, axis=1)[:, None]
    place = np.stack([np.cos(1.1 * t), np.sin(0.7 * t), 0.3 * np.sin(1.7 * t)], axis=1)
    v = np.stack([-1.1 * np.sin(1.1 * t), 0.7 * np.cos(0.7 * t), 0.51 * np.cos(1.7 * t)], axis=1)
    a = np.stack(
        [-1.21 * np.cos(1.1 * t), -0.49 * np.sin(0.7 * t), -0.867 * np.sin(1.7 * t)], axis=1
    )
    turned = transform.Rotation.from_quat(p, scalar_first=True)
    force = turned.inv().apply(a - np.array([0.0, 0.0, -9.81]))
    return {"p": p, "r": place, "v": v, "gyroscope": omega(t).T, "accelerometer": force}


@pytest.fixture(scope="module")
def inertial():
    """Function (motion, faulty fix (k, 3), NaN flags (k,)) -> NEES, counts and errors over seeds, compiled once."""
    scene = stm.make_scene("hexacopter")
    body = "hexacopter"
    units = [
        Instrument(sensing.Gyroscope(body), noise=NOISES["gyroscope"]),
        Instrument(sensing.Accelerometer(body), noise=NOISES["accelerometer"]),
        Instrument(sensing.PositionFix(body), rate=50.0, noise=NOISES["position"]),
        Instrument(sensing.AttitudeFix(body), rate=100.0, noise=NOISES["attitude"]),
    ]
    estimator = stm.uav.MotionEstimator(
        scene.system, RATE, units, gyroscope_drift=0.0, accelerometer_drift=0.0
    )
    names = estimator.names

    def run(motion, off, fix_missing, imu_missing, seed):
        keys = jax.random.split(jax.random.key(seed), 7)
        normal = lambda k, *shape: jax.random.normal(keys[k], shape)
        count = len(motion["r"])
        spreads = [0.02, 0.05, 0.05, 0.02, 0.1]
        biases = 0.02 * normal(0, 3), 0.1 * normal(1, 3)
        start = {"p": motion["p"][0], "r": motion["r"][0], "v": motion["v"][0]}
        start |= {"gyroscope_bias": jnp.zeros(3), "accelerometer_bias": jnp.zeros(3)}
        apart = jnp.concatenate(
            [jnp.repeat(jnp.array(spreads[:3]), 3) * normal(2, 9), jnp.zeros(6)]
        )
        guess = SPACE.retract(start, apart)
        state = State(guess["r"][None], guess["p"][None], guess["v"][None], jnp.zeros((1, 3)))
        memory = estimator.start(state)
        read = {
            "w": motion["gyroscope"] + biases[0] + NOISES["gyroscope"] * normal(3, count, 3),
            "f": motion["accelerometer"]
            + biases[1]
            + NOISES["accelerometer"] * normal(4, count, 3),
            "r": motion["r"] + off + NOISES["position"] * normal(5, count, 3),
            "p": jax.vmap(Rotation().retract)(
                motion["p"], NOISES["attitude"] * normal(6, count, 3)
            ),
        }
        read["r"] = jnp.where(fix_missing[:, None], jnp.nan, read["r"])
        read["w"], read["f"] = (
            jnp.where(imu_missing[:, None], jnp.nan, read[name]) for name in ("w", "f")
        )

        def step(memory, now):
            k, seen, truth = now
            fresh = (jnp.array(True), jnp.array(True), k % 8 == 0, k % 4 == 0)
            given = {
                name: control.Reading(value, new)
                for name, value, new in zip(
                    names, (seen["w"], seen["f"], seen["r"], seen["p"]), fresh, strict=True
                )
            }
            found, memory = estimator(given, jnp.zeros(0), memory)
            exact = truth | {"gyroscope_bias": biases[0], "accelerometer_bias": biases[1]}
            error = SPACE.difference(exact, found.base.mean)
            nees = error @ jnp.linalg.solve(found.base.covariance, error)
            return memory, (nees, found.nis, found.components, found.missing, found.gated, error)

        exact = {name: motion[name] for name in ("p", "r", "v")}
        _, out = jax.lax.scan(step, memory, (jnp.arange(count), read, exact))
        return out

    whole = jax.jit(jax.vmap(run, in_axes=(None, None, None, None, 0)))
    count = int(SECONDS * RATE) + 1

    def over_seeds(motion, off=None, fix_missing=None, imu_missing=None):
        given = {name: jnp.asarray(value) for name, value in motion.items()}
        none = jnp.zeros(count, bool)
        return jax.tree.map(
            np.asarray,
            whole(
                given,
                jnp.zeros((count, 3)) if off is None else jnp.asarray(off),
                none if fix_missing is None else jnp.asarray(fix_missing),
                none if imu_missing is None else jnp.asarray(imu_missing),
                jnp.arange(SEEDS),
            ),
        )

    return over_seeds


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.1, 1.3, 4.0])
def test_a_turning_machine_is_estimated_as_well_as_said(inertial, rate):
    """NEES of all 15 errors over 100 seeds, at the end of 4 s in which the machine turns."""
    nees, nis, components, missing, gated, _ = inertial(truth(rate))
    low, high = stm.estimation.mean_interval(15, SEEDS, 0.95)
    assert low < np.mean(nees[:, -1]) < high
    # at other times too; one of four at a level of 99.9 %
    low, high = stm.estimation.mean_interval(15, SEEDS, 0.999)
    for k in (200, 800, 1200):
        assert low < np.mean(nees[:, k]) < high
    assert np.sum(nis) / np.sum(components) == pytest.approx(1.0, abs=0.01)
    assert not np.any(missing)
    # of 100,000 fixes at a probability of 1e-6
    assert np.sum(gated[:, -1]) <= 2


@pytest.mark.slow
def test_missing_readings_and_a_fix_far_out_leave_it_consistent(inertial):
    """A fix of NaN and one 20 deviations off are left out; 0.1 s without the inertial unit are an uncertainty."""
    motion, count = truth(4.0), int(SECONDS * RATE) + 1
    imu_missing = (np.arange(count) >= 1300) & (np.arange(count) < 1340)
    fix_missing = np.arange(count) == 400
    off = np.where(np.arange(count)[:, None] == 800, 20 * NOISES["position"], 0.0) * np.array(
        [1.0, 0, 0]
    )
    nees, _, _, missing, gated, _ = inertial(motion, off, fix_missing, imu_missing)
    low, high = stm.estimation.mean_interval(15, SEEDS, 0.999)
    for k in (400, 416, 800, 816, 1200):
        assert low < np.mean(nees[:, k]) < high
    assert np.all(missing[:, -1] == [40, 40, 1, 0])
    # a fix of 20 deviations is beyond the gate in every run, the prediction being as good as a fix
    assert np.all(gated[:, -1, 2] == 1)
    # not overconfident in the gap: the changes allowed for are larger than those of this motion
    assert np.all(np.isfinite(nees))
    assert np.max(np.mean(nees[:, 1300:], axis=0)) < 1.2 * high


@pytest.mark.slow
def test_fixes_that_all_lie_beyond_the_gate_are_taken_in_the_end(inertial):
    """Where the start is wrong by 30 deviations of a fix, the estimate comes back to the fixes."""
    off = np.ones((int(SECONDS * RATE) + 1, 3)) * np.array([1.5, 0.0, 0.0])
    _, _, _, _, gated, error = inertial(truth(0.1), off)
    assert np.all(gated[:, -1, 2] >= 10)
    # the fixes' own offset is where the estimate has gone
    assert np.max(np.abs(error[:, -1, 3] + 1.5)) < 0.2


@pytest.mark.slow
def test_errors_move_as_the_kinematics_do():
    """The matrix of the errors against automatic derivatives of the motion."""
    keys = jax.random.split(jax.random.key(5), 6)
    drawn = lambda k, size: jax.random.normal(keys[k], (size,))
    p = stm.rotation.normalise(drawn(0, 4))
    x = {"p": p, "r": drawn(1, 3), "v": drawn(2, 3), "gyroscope_bias": 0.1 * drawn(3, 3)}
    x["accelerometer_bias"] = 0.1 * drawn(4, 3)
    turning, force = 2.0 * drawn(5, 3), jnp.array([0.5, -1.0, 9.0])
    g, h = jnp.array([0.0, 0.0, -9.81]), jnp.asarray(1 / RATE)

    def end(v):
        moved = stm.estimation.strapdown(SPACE.retract(x, v), turning, force, g, h)[0]
        return SPACE.difference(moved, stm.estimation.strapdown(x, turning, force, g, h)[0])

    exact = quick_jit(jax.jacfwd(end))(jnp.zeros(15))
    _, errors = stm.estimation.strapdown(x, turning, force, g, h)
    # what is left out: the gyroscope's bias within a step, h^2 |f| / 2 and h^2 |omega| / 2
    left_out = np.array(exact - errors)
    assert np.max(np.abs(left_out[:, 9:12])) < h**2 * 10
    left_out[:, 9:12] = 0
    assert np.max(np.abs(left_out)) < 1e-12


def test_instruments_that_do_not_suffice_are_refused():
    scene = stm.make_scene("hexacopter")
    good = instruments("hexacopter")
    with pytest.raises(stm.SettingError, match=r"there is no 'attitude hexacopter'.* attitude z"):
        stm.uav.MotionEstimator(scene.system, RATE, good[:3])
    slow = Instrument(sensing.Gyroscope("hexacopter"), rate=200.0, noise=TURNING)
    with pytest.raises(stm.SettingError, match=r"at every control period .* 200 Hz"):
        stm.uav.MotionEstimator(scene.system, RATE, [slow, *good[1:]])
    silent = Instrument(sensing.PositionFix("hexacopter"), rate=50.0)
    with pytest.raises(stm.SettingError, match="noise of 'position hexacopter'"):
        stm.uav.MotionEstimator(scene.system, RATE, [*good[:2], silent, good[3]])
    off = Instrument(sensing.Accelerometer("hexacopter", [0.1, 0.0, 0.0]), noise=FORCE)
    with pytest.raises(stm.SettingError, match="at the centre of mass"):
        stm.uav.MotionEstimator(scene.system, RATE, [good[0], off, *good[2:]])
