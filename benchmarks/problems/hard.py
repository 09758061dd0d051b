"""Hard cases with known motions: large ratios of mass and stiffness, fast rotation, impacts.

Every case runs as a user would run it, with the defaults of `simulate` unless its text says
otherwise, and is compared with a closed form or with a solution by SciPy that shares no code with
the package. A start at rest in a singular posture has no motion to compare with: it has to be refused, and
its joints named.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from problems import four_bar
from problems.bricard import bricard, exact_centres, slope_of, swing
from problems.conservative import DOWN_Y, DOWN_Z, SMALL, Problem, moving, tracker_turning
from scipy.integrate import quad, solve_ivp
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

import stmuav_jax as stm

G = 9.81  # m/s^2
ORIGIN, X, Z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


class Hard(NamedTuple):
    """A hard case.

    Attributes:
        name: name of the case. why: what makes it hard. truth: what it is compared with.
        demanded: largest error that is accepted, in `unit`.
        build: makes the system, its start and the output times.
        error: largest error of a run, in `unit`.
        method: settings that differ from the defaults; they are part of the case.
        of_positions: whether its error is one of the bodies' positions alone.
    """

    name: str
    why: str
    truth: str
    demanded: float
    unit: str
    build: Callable[[], tuple[stm.System, stm.State, np.ndarray]]
    error: Callable[[stm.Run], float]
    method: dict[str, Any] = {}  # noqa: RUF012 - never changed
    of_positions: bool = True


def horizontal_release(t: np.ndarray, length: float) -> np.ndarray:
    """Place (k, 2) [m] of a simple pendulum that is released at rest at (-length, 0)."""
    k = np.sin(np.pi / 4)
    _, cn, dn, _ = ellipj(np.sqrt(G / length) * t, k * k)
    theta = 2 * np.arcsin(k * cn / dn)
    return -length * np.stack([np.sin(theta), np.cos(theta)], axis=1)


def apart(run: stm.Run, body: int, exact: np.ndarray, at: Any = ORIGIN) -> float:
    """Largest distance of a body from its exact path (k, 2) or (k, 3), given relative to a point."""
    found = np.asarray(run.states.r)[:, body] - np.asarray(at)
    return float(np.max(np.linalg.norm(found[:, : exact.shape[1]] - exact, axis=1)))


def swinging(length: float, span: float, centre: Any = ORIGIN) -> Any:
    """A point mass on a bar, released with the bar horizontal, for so many radians of a small swing."""

    def build() -> tuple[stm.System, stm.State, np.ndarray]:
        start = np.asarray(centre) - length * np.array(X)
        bob = stm.Body("bob", 1.0, np.asarray(SMALL) * length**2, position=start)
        rod = stm.distance("rod", "ground", "bob", point_i=centre, point_j=start)
        system = stm.System([bob], [rod], [stm.Gravity(DOWN_Y)])
        return system, system.reference, np.linspace(0.0, span * np.sqrt(length / G), 41)

    return build, lambda run: apart(run, 0, horizontal_release(run.ts, length), centre)


def cart_and_bob(cart: float, span: float) -> tuple[stm.System, stm.State, np.ndarray]:
    """A cart on a horizontal rail and a bob of 1 kg on a hinged rod of 1 m, released horizontally."""
    bodies = [stm.Body("cart", cart, cart * np.asarray(SMALL)),
              stm.Body("bob", 1.0, SMALL, position=(-1.0, 0.0, 0.0))]  # fmt: skip
    joints = [
        stm.translational("rail", "ground", "cart", point=ORIGIN, axis=X),
        stm.distance("rod", "cart", "bob", point_i=ORIGIN, point_j=(-1.0, 0.0, 0.0)),
    ]
    system = stm.System(bodies, joints, [stm.Gravity(DOWN_Y)])
    return system, system.reference, np.linspace(0.0, span, 41)


def free_fall(run: stm.Run) -> float:
    """The bob of a cart without mass falls freely: nothing holds its rod in line."""
    exact = np.stack([np.full_like(run.ts, -1.0), -0.5 * G * run.ts**2], axis=1)
    return apart(run, 1, exact)


def light_rod() -> tuple[stm.System, stm.State, np.ndarray]:
    """A pendulum whose rod, a body of 1e-9 kg, is hinged to ground and to the bob of 1 kg."""
    mass = 1e-9
    rod = stm.Body("rod", mass, (mass / 12,) * 3, position=(-0.5, 0.0, 0.0))
    bob = stm.Body("bob", 1.0, SMALL, position=(-1.0, 0.0, 0.0))
    joints = [
        stm.revolute("foot", "ground", "rod", point=ORIGIN, axis=Z),
        stm.revolute("tip", "rod", "bob", point=(-1.0, 0.0, 0.0), axis=Z),
    ]
    system = stm.System([rod, bob], joints, [stm.Gravity(DOWN_Y)])
    return system, system.reference, np.linspace(0.0, 5.0, 41)


# --- one body in free rotation
SPIN, WOBBLE, DISK = 1000.0, 10.0, (1e-2, 1e-2, 2e-2)  # rad/s, rad/s, kg m^2
UNEQUAL, TUMBLE = (1.0, 2.0, 3.0), (1e-3, 5.0, 0.0)  # kg m^2, rad/s


def spinning(inertia: Any, omega: Any, span: float) -> Callable[[], Any]:
    """A free body that starts turning at omega [rad/s] in its own axes."""

    def build() -> tuple[stm.System, stm.State, np.ndarray]:
        system = stm.System([stm.Body("body", 1.0, inertia, free=True)])
        return system, moving(system, [ORIGIN], [omega]), np.linspace(0.0, span, 41)

    return build


def disk_turned(run: stm.Run) -> float:
    """Angle [rad] between a run and the regular precession of a symmetric body."""
    omega = np.array([WOBBLE, 0.0, SPIN])
    # R(t) = exp(t L / I_1) exp(t s e_3): precession about the angular momentum, then own spin
    momentum, own = np.asarray(DISK) * omega / DISK[0], SPIN * (1 - DISK[2] / DISK[0])
    exact = Rotation.from_rotvec(np.outer(run.ts, momentum)) * Rotation.from_rotvec(
        np.outer(run.ts, (0.0, 0.0, own))
    )
    found = Rotation.from_quat(np.asarray(run.states.p)[:, 0], scalar_first=True)
    return float(np.max((found * exact.inv()).magnitude()))


def flips(run: stm.Run) -> float:
    """Largest error of the angular velocity [rad/s], against Euler's equations in SciPy."""
    inertia = np.asarray(UNEQUAL)
    rate = lambda _, w: np.cross(inertia * w, w) / inertia
    how = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
    exact = solve_ivp(rate, run.ts[[0, -1]], TUMBLE, t_eval=run.ts, **how).y.T
    return float(np.max(np.abs(np.asarray(run.states.omega)[:, 0] - exact)))


# --- a fast top in steady precession
TOP_MASS, TOP_ARM, TOP_INERTIA = 1.0, 0.1, (2e-3, 2e-3, 1e-3)  # kg, m, kg m^2 about the mass centre
LEAN, TOP_SPIN = 0.5, 2000.0  # rad from upright, rad/s in the body's own axes


def top_rate() -> float:
    """Slow rate of steady precession [rad/s] of the top about the vertical."""
    about_tip = TOP_INERTIA[0] + TOP_MASS * TOP_ARM**2
    # (I_1 cos) rate^2 - L_3 rate + m g l = 0, with L_3 = I_3 omega_3
    b = TOP_INERTIA[2] * TOP_SPIN
    a, c = about_tip * np.cos(LEAN), TOP_MASS * G * TOP_ARM
    return float(2 * c / (b + np.sqrt(b * b - 4 * a * c)))


def steady_top() -> tuple[stm.System, stm.State, np.ndarray]:
    """The top, its tip held by a spherical joint, started so that it keeps its lean."""
    lean = Rotation.from_rotvec((LEAN, 0.0, 0.0))
    body = stm.Body(
        "top", TOP_MASS, TOP_INERTIA, position=lean.apply((0.0, 0.0, TOP_ARM)),
        orientation=lean.as_quat(scalar_first=True),
    )  # fmt: skip
    tip = stm.spherical("tip", "ground", "top", point=ORIGIN)
    system = stm.System([body], [tip], [stm.Gravity(DOWN_Z)])
    world = np.array([0.0, 0.0, top_rate()])
    own = lean.inv().apply(world) * (1, 1, 0) + np.array([0.0, 0.0, TOP_SPIN])
    at = np.asarray(system.reference.r[0])
    state = moving(system, [np.cross(lean.apply(own), at)], [own])
    return system, state, np.linspace(0.0, 1.0, 41)


def top_off(run: stm.Run) -> float:
    """Distance of the mass centre [m] from its horizontal circle."""
    angle = top_rate() * run.ts
    lean, height = TOP_ARM * np.sin(LEAN), TOP_ARM * np.cos(LEAN)
    # the axis leans towards -y at the start
    circle = np.stack(
        [lean * np.sin(angle), -lean * np.cos(angle), np.full_like(angle, height)], axis=1
    )
    return apart(run, 0, circle)


# --- bodies on a straight rail
def on_rail(count: int) -> tuple[list[stm.Body], list[stm.Joint]]:
    """Bodies of 1 kg, 1 m apart along x, that slide along it."""
    bodies = [stm.Body(f"m{k}", 1.0, SMALL, position=(float(k), 0.0, 0.0)) for k in range(count)]
    joints = [
        stm.translational(f"rail{k}", "ground", f"m{k}", point=(float(k), 0.0, 0.0), axis=X)
        for k in range(count)
    ]
    return bodies, joints


SOFT, STIFF, STIFF_DAMPING = 10.0, 1e9, 1e4  # N/m, N/m, N s/m


def stiff_pair() -> tuple[stm.System, stm.State, np.ndarray]:
    """Two bodies joined by 1e9 N/m and held by 10 N/m, pulled out by 0.1 m."""
    bodies, joints = on_rail(2)
    springs = [
        stm.LinearSpringDamper(
            "ground", "m0", point_i=(-1.0, 0.0, 0.0), stiffness=SOFT, length=1.0
        ),
        stm.LinearSpringDamper("m0", "m1", stiffness=STIFF, damping=STIFF_DAMPING, length=1.0),
    ]
    system = stm.System(bodies, joints, springs)
    rest = system.reference
    out = stm.State(rest.r + 0.1 * jnp.array(X), rest.p, rest.v, rest.omega)
    return system, out, np.linspace(0.0, 5.0, 41)


def stiff_off(run: stm.Run) -> float:
    """Largest error of either body [m], against their motion as one; it lacks terms of 1e-9 m."""
    exact = 0.1 * np.cos(np.sqrt(SOFT / 2) * run.ts)
    found = np.asarray(run.states.r)[:, :, 0] - np.arange(2.0)
    return float(np.max(np.abs(found - exact[:, None])))


JUMP, PUSH, PULL = 0.31370, 3.0, -7.0  # s, N, N


def pushed() -> tuple[stm.System, stm.State, np.ndarray]:
    """A body on a rail whose force jumps at a time not given to the solver."""
    bodies, joints = on_rail(1)
    force = lambda t, _: jnp.where(t < JUMP, PUSH, PULL) * jnp.array([1.0, 0.0, 0.0])
    system = stm.System(bodies, joints, [stm.AppliedForce("m0", force)])
    return system, system.reference, np.linspace(0.0, 1.0, 21)


def pushed_off(run: stm.Run) -> float:
    """Largest error [m] against the two parabolas."""
    after = np.maximum(run.ts - JUMP, 0.0)
    exact = 0.5 * PUSH * run.ts**2 + 0.5 * (PULL - PUSH) * after**2
    return apart(run, 0, exact[:, None])


STOP, WIDTH, SPEED, GAP = 1e8, 1e-4, 2.0, 0.05  # N/m, m, m/s, m


def between_stops() -> tuple[stm.System, stm.State, np.ndarray]:
    """A body of 1 kg that flies to and fro between two elastic stops of 1e8 N/m."""
    bodies, joints = on_rail(1)
    stop = stm.mechanics.EndStop(
        "rail0", lower=-GAP, upper=GAP, stiffness=STOP, damping=0.0, width=WIDTH
    )
    system = stm.System(bodies, joints, [stop])
    return system, moving(system, [(SPEED, 0.0, 0.0)], [ORIGIN]), np.linspace(0.0, 1.0, 101)


def ramp(d: float) -> float:
    """The documented shape of an end stop's push over its depth [m]."""
    u = d / WIDTH
    return WIDTH * u**4 * (2.5 - 3 * u + u * u) if u < 1 else d - WIDTH / 2


def stops_off(run: stm.Run) -> float:
    """Largest error [m] outside the stops, against the time of a contact by quadrature."""
    work = lambda d: STOP * quad(ramp, 0.0, d, epsabs=0, epsrel=1e-13, points=[min(d, WIDTH)])[0]
    low, high = 0.0, 10 * SPEED / np.sqrt(STOP) + WIDTH
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if work(middle) < 0.5 * SPEED**2 else (low, middle)
    depth = low
    # d = depth sin(a) takes the root's zero at the turning point away
    pace = lambda a: depth * np.cos(a) / np.sqrt(max(SPEED**2 - 2 * work(depth * np.sin(a)), 1e-30))
    contact = 2 * quad(pace, 0.0, np.pi / 2 * (1 - 1e-9), epsabs=0, epsrel=1e-10, limit=200)[0]
    flight = 2 * GAP / SPEED
    cycle = 2 * (flight + contact)
    # time since the body left the lower stop
    since = np.mod(run.ts + flight / 2, cycle)
    forth = since < flight
    back = (since >= flight + contact) & (since < 2 * flight + contact)
    exact = np.where(forth, SPEED * since - GAP, GAP - SPEED * (since - flight - contact))
    off = np.abs(np.asarray(run.states.r)[:, 0, 0] - exact)
    return float(np.max(off[forth | back]))


# --- constraints that depend on time, and loops
CRANK, ROD, TURNS = 0.1, 0.3, 100.0  # m, m, rad/s


def angle_of(t: Any, sin: Any) -> Any:
    """Angle of the crank [rad]."""
    return TURNS * t + 0.3 * sin(7.0 * t)


def slider_crank(rate: float, *motors: Callable[..., stm.Joint]) -> tuple[stm.System, stm.State]:
    """A slider-crank at a dead point, turning at a rate [rad/s], with motors at its first hinge."""
    places = ((CRANK / 2, 0.0, 0.0), (CRANK + ROD / 2, 0.0, 0.0), (CRANK + ROD, 0.0, 0.0))
    names = ("crank", "rod", "slider")
    bodies = [stm.Body(n, 1.0, SMALL, position=r) for n, r in zip(names, places, strict=True)]
    joints = [
        stm.revolute("foot", "ground", "crank", point=ORIGIN, axis=Z),
        stm.revolute("knee", "crank", "rod", point=(CRANK, 0.0, 0.0), axis=Z),
        stm.revolute("wrist", "rod", "slider", point=places[2], axis=Z),
        stm.translational("rail", "ground", "slider", point=places[2], axis=X),
    ]
    driven = [motor(joints[0]) for motor in motors]
    system = stm.System(bodies, [*joints, *driven], [stm.Gravity(DOWN_Y)])
    v = [(0.0, rate * CRANK / 2, 0.0), (0.0, rate * CRANK / 2, 0.0), ORIGIN]
    return system, moving(system, v, rate * np.outer((1.0, -CRANK / ROD, 0.0), Z))


def driven_crank() -> tuple[stm.System, stm.State, np.ndarray]:
    """A slider-crank whose crank is driven at about 100 rad/s by a function of time."""
    angle = lambda t: angle_of(t, jnp.sin)
    motor = lambda hinge: stm.drive("motor", hinge, angle, coordinate="angle")
    return *slider_crank(TURNS + 0.3 * 7.0, motor), np.linspace(0.0, 2.0, 81)


def crank_off(run: stm.Run) -> float:
    """Largest error of the slider [m], against the geometry."""
    phi = angle_of(run.ts, np.sin)
    exact = CRANK * np.cos(phi) + np.sqrt(ROD**2 - (CRANK * np.sin(phi)) ** 2)
    return apart(run, 2, exact[:, None])


def four_bars(loops: int, coupler: float = 1.0) -> Any:
    """Four-bars with couplers of so many kg; the error [m] is that of the first crank's end."""

    def build() -> tuple[stm.System, stm.State, np.ndarray]:
        system = four_bar.four_bar(loops, coupler=coupler)
        return system, four_bar.start(system), np.linspace(0.0, 5.0, 41)

    def off(run: stm.Run) -> float:
        exact = four_bar.closed_form(loops, np.asarray(run.ts), coupler)[:, :2]
        return float(np.max(np.abs(2 * np.asarray(run.states.r)[:, 0, :2] - exact)))

    return build, off


def turning_tracker() -> tuple[stm.System, stm.State, np.ndarray]:
    """The report's tracker without gravity, its panel set turning, for ten minutes."""
    found: Problem = tracker_turning()
    return found.system, found.state, np.linspace(0.0, 600.0, 61)


def drift(run: stm.Run) -> float:
    """Relative change of the energy; not a number where the joints have opened by 1e-10 m."""
    held = run.certificate.position_violation <= 1e-10
    return float(run.certificate.relative_energy_error) if held else float("nan")


# --- closed loops, long times, and starts at which branches of the motion meet
FREE_SPIN = 12.0  # rad/s of the free crank at the start


def cube() -> tuple[stm.System, stm.State, np.ndarray]:
    """Bricard's linkage, released in the cube."""
    system = bricard()
    return system, system.reference, np.linspace(0.0, 5.0, 21)


def cube_off(run: Any) -> float:
    """Largest error of a rod's centre [m], against the linkage's motion in its one coordinate."""
    off = np.asarray(run.states.r) - exact_centres(np.asarray(run.ts))
    return float(np.max(np.linalg.norm(off, axis=2)))


def free_crank() -> tuple[stm.System, stm.State, np.ndarray]:
    """A slider-crank that is let go turning from a dead point, crank and rod in line."""
    return *slider_crank(FREE_SPIN), np.linspace(0.0, 5.0, 41)


def crank_bodies(phi: Any) -> tuple[np.ndarray, Any]:
    """Centres (3, 2) [m] and the rod's angle [rad] at an angle of the crank."""
    knee = CRANK * np.array([np.cos(phi), np.sin(phi)])
    lean = -np.arcsin(knee[1] / ROD)
    wrist = np.array([knee[0] + ROD * np.cos(lean), 0.0 * phi])
    return np.stack([knee / 2, (knee + wrist) / 2, wrist]), lean


def crank_inertia(phi: float) -> float:
    """Generalised inertia of the crank's angle [kg m^2]."""
    places, lean = (slope_of(lambda x, k=k: crank_bodies(x)[k], phi) for k in (0, 1))
    return float(np.sum(places**2) + SMALL[2] * (1 + lean**2))


def free_crank_off(run: Any) -> float:
    """Largest error of the slider [m], against the motion in the crank's angle alone."""
    potential = lambda x: G * np.sum(crank_bodies(x)[0][:, 1])
    phi = swing(crank_inertia, potential, 0.0, FREE_SPIN, np.asarray(run.ts))
    exact = np.array([crank_bodies(x)[0][2, 0] for x in phi])
    return apart(run, 2, exact[:, None])


_pendulum = "closed form (elliptic functions)"
CASES: tuple[Hard, ...] = (
    Hard("mass ratio 1e9, heavy cart", "a bob of 1 kg hangs on a cart of 1e9 kg",
         f"{_pendulum} of a fixed pivot", 1e-6, "m", lambda: cart_and_bob(1e9, 5.0),
         lambda run: apart(run, 1, horizontal_release(run.ts, 1.0))),
    Hard("mass ratio 1e9, light cart", "a bob of 1 kg hangs on a cart of 1e-9 kg", "free fall",
         1e-6, "m", lambda: cart_and_bob(1e-9, 0.3), free_fall),
    Hard("massless link", "a rod of 1e-9 kg between two hinges carries 1 kg", _pendulum, 1e-6, "m",
         light_rod, lambda run: apart(run, 1, horizontal_release(run.ts, 1.0))),
    Hard("stiffness 1e9 beside 10 N/m", "eigenvalues of 1 and of 1e5 1/s, solver \"auto\"",
         "both as one body, exact to 1e-9 m", 1e-6, "m", stiff_pair, stiff_off, {"solver": "auto"}),
    Hard("fast rotation", "a free disk at 1,000 rad/s, 159 turns", "regular precession", 1e-4,
         "rad", spinning(DISK, (WOBBLE, 0.0, SPIN), 1.0), disk_turned, of_positions=False),
    Hard("intermediate axis", "a free body flips repeatedly about its unstable axis",
         "Euler's equations in SciPy, 1e-13", 1e-3, "rad/s", spinning(UNEQUAL, TUMBLE, 15.0), flips,
         of_positions=False),
    Hard("fast top", "a heavy top at 2,000 rad/s in steady precession", "circle at the slow rate of precession",
         1e-6, "m", steady_top, top_off),
    Hard("jump of a force", "a force changes its sign at a time not given to the solver", "parabolas",
         1e-6, "m", pushed, pushed_off),
    Hard("jump of a force, time given", "the same with `jump_ts`", "parabolas", 1e-12, "m", pushed,
         pushed_off, {"jump_ts": (JUMP,)}),
    Hard("impacts on end stops", "19 elastic impacts on 1e8 N/m, of 0.3 ms each",
         "time of a contact by quadrature", 1e-5, "m", between_stops, stops_off),
    Hard("time-dependent constraint", "a slider-crank driven at 100 rad/s", "geometry", 1e-9, "m",
         driven_crank, crank_off),
    Hard("singular posture, mass ratio 1e6", "a four-bar passes postures with all rods in line",
         "closed form", 1e-4, "m", *four_bars(1, 1e6)),
    Hard("far from the origin", "a pendulum of 1 m at 100 km and more", _pendulum, 1e-6, "m",
         *swinging(1.0, 15.0, (1e5, -2e5, 1e5))),
    Hard("small", "a pendulum of 0.1 mm", _pendulum, 1e-9, "m", *swinging(1e-4, 15.0)),
    Hard("large", "a pendulum of 1,000 km, for an hour and a half", _pendulum, 0.1, "m",
         *swinging(1e6, 15.0)),
    Hard("ten minutes of the tracker", "closed loops in chaotic motion, rtol 1e-11",
         "initial energy, joints closed to 1e-10 m", 1e-8, "relative", turning_tracker, drift,
         {"rtol": 1e-11, "atol": 1e-11}, of_positions=False),
    Hard("redundant loops, Bricard", "one of 30 rows depends on the others wherever the loop closes",
         "equation of its one coordinate, SciPy at 1e-12", 1e-6, "m", cube, cube_off),
    Hard("redundant loops, four-bars", "four loops with twelve dependent rows, through postures in line",
         "closed form", 1e-4, "m", *four_bars(4)),
    Hard("dead points", "a free slider-crank turns from one dead point through the others",
         "equation of the crank's angle, SciPy at 1e-12", 1e-5, "m", free_crank, free_crank_off),
    Hard("2,000 s of a pendulum", "errors accumulate over 845 swings, rtol 1e-11",
         "closed form (elliptic functions)", 1e-3, "m", *swinging(1.0, 2000.0 * np.sqrt(G)),
         method={"rtol": 1e-11, "atol": 1e-11}),
)  # fmt: skip


def in_line(centre: float) -> stm.System:
    """A parallelogram whose rods all lie in line; `centre` is the last rod's, its foot at 1 m."""
    small = (1e-2, 1e-2, 1e-2)
    places = (0.5, 1.5, centre)
    bodies = [stm.Body(f"rod{k}", 1.0, small, position=(x, 0.0, 0.0)) for k, x in enumerate(places)]
    ends, names = (0.0, 1.0, 2.0, 1.0), ("ground", "rod0", "rod1", "rod2", "ground")
    joints = [
        stm.revolute(f"R{k}", names[k], names[k + 1], point=(ends[k], 0.0, 0.0), axis=Z)
        for k in range(4)
    ]
    return stm.System(bodies, joints, [stm.Gravity(DOWN_Y)])


STARTS: tuple[tuple[str, str, Callable[[], stm.System]], ...] = (
    ("folded four-bar", "its last rod's weight acts beyond its foot: no branch is in equilibrium",
     lambda: in_line(0.5)),
    ("four-bar in line", "its rods can fall as a parallelogram or crossed: both satisfy the "
     "constraints", lambda: in_line(1.5)),
)  # fmt: skip
# Tolerances at which the pendulum of 1 m is run, each with the error demanded: 1,000 of them.
TOLERANCES = tuple(10.0**-k for k in range(2, 14))


def run_of(case: Hard, **method: Any) -> stm.Run:
    """The run of a case; it tells in its certificate if it ended early."""
    system, state, ts = case.build()
    how = stm.Method(**{"max_steps": 100_000, **case.method, **method})
    return stm.simulate(system, state, ts=ts, method=how, throw=False)
