"""heyoka: Taylor series of high order, compiled by LLVM, from symbolic equations of motion.

heyoka integrates explicit differential equations and has no model of mechanisms. The equations are written
here as a user of it would write them: coordinates of a spanning tree, the mass matrix from the
bodies' Jacobians, and the cut joints' rows by Lagrange multipliers, solved symbolically by Cholesky
factors. It shares coordinates, but no equation with the package.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from problems.plain import loop_seconds, start, starts
from problems.tree import coordinates

from peers.adapter import Outcome, Peer, Prepared, Setting, looked_at, tolerances
from peers.pinocchio_model import WIDTH, generalised, linked, why_no_joint_forces
from stmuav_jax import Scene, State

# Coordinates of a link; their rates are as wide as `WIDTH`, of free links and balls (velocity,)
# angular velocity in body axes.
COUNT = {"free": 7, "ball": 4, "turn": 1, "slide": 1, "universal": 2}


def rotation(axis: int, angle: Any) -> np.ndarray:
    """Rotation (3, 3) about a coordinate axis, symbolic."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    c, s = hy.cos(angle), hy.sin(angle)
    result = np.eye(3).astype(object)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    result[[i, i, j, j], [i, j, i, j]] = [c, -s, s, c]
    return result


def of_quaternion(e: np.ndarray) -> np.ndarray:
    """Body-to-world rotation (3, 3) of Euler parameters (4,), symbolic."""
    w, x, y, z = e
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def quaternion_rate(e: np.ndarray, omega: np.ndarray) -> list[Any]:
    """Rates of Euler parameters (4,) for an angular velocity in body axes (3,)."""
    w, v = e[0], e[1:]
    return [-0.5 * (v @ omega), *(0.5 * (w * omega + np.cross(v, omega)))]


@dataclass
class Motion:
    """Symbolic motion of a link in world axes.

    Attributes:
        R: (3, 3). x: origin (3,). omega: angular velocity. turn_bias, bias: accelerations where those of
            the coordinates vanish. axes: (coordinate, axis of its turn or None, that of its slide or None, origin).
    """

    R: np.ndarray
    x: np.ndarray
    omega: np.ndarray
    turn_bias: np.ndarray
    bias: np.ndarray
    axes: list[tuple[int, Any, Any, np.ndarray]]

    def point(self, place: np.ndarray) -> np.ndarray:
        """World place of a point in the link's axes."""
        return self.x + self.R @ place

    def point_bias(self, place: np.ndarray) -> np.ndarray:
        """Acceleration of a point where those of the coordinates vanish."""
        arm = self.R @ place
        turned = np.cross(self.turn_bias, arm) + np.cross(self.omega, np.cross(self.omega, arm))
        return self.bias + turned

    def jacobians(self, place: np.ndarray) -> dict[int, tuple[np.ndarray, np.ndarray | None]]:
        """Velocity of a point, and angular velocity, by each coordinate's rate."""
        at = self.point(place)
        return {
            k: (slide, None) if turn is None else (np.cross(turn, at - origin), turn)
            for k, turn, slide, origin in self.axes
        }


_ZERO = np.zeros(3)
GROUND = Motion(np.eye(3), _ZERO, _ZERO, _ZERO, _ZERO, [])


class Equations:
    """Explicit differential equations of a scene, symbolic."""

    def __init__(self, scene: Scene) -> None:
        import heyoka as hy  # pyright: ignore[reportMissingImports]

        self.hy: Any = hy
        self.tree, self.links = linked(scene)
        kinds = [link.kind for link in self.links.links]
        make = lambda name, widths: [
            np.array([hy.expression(f"{name}{k}_{i}") for i in range(widths[kind])])
            for k, kind in enumerate(kinds)
        ]
        self.q, self.v = make("q", COUNT), make("v", WIDTH)
        self.first = np.cumsum([0, *(WIDTH[kind] for kind in kinds)])
        self.motions = self._follow()

    def start(self, state: State) -> np.ndarray:
        """The state as heyoka's vector: all coordinates, then all rates."""
        places, rates = zip(*coordinates(self.tree, state), strict=True)
        return np.concatenate([*places, *rates])

    def system(self) -> list[tuple[Any, Any]]:
        """Pairs of variables and their rates."""
        rates = [
            rate
            for link, q, v in zip(self.links.links, self.q, self.v, strict=True)
            for rate in self._coordinate_rates(link.kind, q, v)
        ]
        variables = [*np.concatenate(self.q), *np.concatenate(self.v)]
        return list(zip(variables, [*rates, *self._accelerations()], strict=True))

    def places(self) -> list[Any]:
        """Centres of mass (3 n), then the gaps of the cut joints."""
        points = [self._motion(k).point(x) for k, x in self.links.bodies]
        gaps = [
            self.links.closed @ (self._motion(b).point(y) - self._motion(a).point(x))
            for a, x, b, y in self.links.cuts
        ]
        # a gap of bodies that stand still would be a plain number
        return [self.hy.expression(0.0) + number for number in np.concatenate([*points, *gaps])]

    def _motion(self, link: int) -> Motion:
        return self.motions[link] if link >= 0 else GROUND

    @staticmethod
    def _coordinate_rates(kind: str, q: np.ndarray, v: np.ndarray) -> list[Any]:
        if kind == "free":
            return [*v[:3], *quaternion_rate(q[3:], v[3:])]
        return quaternion_rate(q, v) if kind == "ball" else list(v)

    def _follow(self) -> list[Motion]:
        motions: list[Motion] = []
        rows = zip(self.links.links, self.q, self.v, self.first[:-1], strict=True)
        for link, q, v, first in rows:
            ahead = motions[link.parent] if link.parent >= 0 else GROUND
            R, x = ahead.R @ link.placement.R, ahead.point(link.placement.x)
            bias = ahead.point_bias(link.placement.x)
            now = Motion(R, x, ahead.omega, ahead.turn_bias, bias, [*ahead.axes])
            columns = range(first, first + WIDTH[link.kind])
            if link.kind == "slide":
                slide = R[:, 2]
                now.axes.append((first, None, slide, x))
                now.bias = now.bias + 2 * np.cross(now.omega, slide * v[0])
                now.x = x + slide * q[0]
                # what the origin has moved along the slide turns with the link ahead
                arm = now.x - x
                turned = np.cross(ahead.omega, np.cross(ahead.omega, arm))
                now.bias = now.bias + np.cross(ahead.turn_bias, arm) + turned
            elif link.kind == "free":
                # only the root is free: nothing ahead of it turns
                now.x = x + R @ q[:3]
                now.axes += [(k, None, R[:, i], x) for i, k in enumerate(columns[:3])]
                self._turn_in_space(now, columns[3:], of_quaternion(q[3:]), v[3:])
            elif link.kind == "ball":
                self._turn_in_space(now, columns, of_quaternion(q), v)
            else:
                axes = (2,) if link.kind == "turn" else (0, 1)
                for axis, k, angle, rate in zip(axes, columns, q, v, strict=True):
                    self._turn(now, k, axis, angle, rate)
            motions.append(now)
        return motions

    @staticmethod
    def _turn(now: Motion, column: int, axis: int, angle: Any, rate: Any) -> None:
        direction = now.R[:, axis]
        now.turn_bias = now.turn_bias + np.cross(now.omega, direction * rate)
        now.omega = now.omega + direction * rate
        now.axes.append((column, direction, None, now.x))
        now.R = now.R @ rotation(axis, angle)

    @staticmethod
    def _turn_in_space(now: Motion, columns: range, turn: np.ndarray, rate: np.ndarray) -> None:
        now.R = now.R @ turn
        relative = now.R @ rate
        now.turn_bias = now.turn_bias + np.cross(now.omega, relative)
        now.omega = now.omega + relative
        now.axes += [(k, now.R[:, i], None, now.x) for i, k in enumerate(columns)]

    def _accelerations(self) -> list[Any]:
        """Rates of the velocities: Lagrange's equations with multipliers of the cut joints."""
        n, zero = int(self.first[-1]), self.hy.expression(0.0)
        M = np.full((n, n), zero)
        f = np.full(n, zero) + self._joint_forces()
        for link, motion in zip(self.links.links, self.motions, strict=True):
            inertia = motion.R @ link.inertia @ motion.R.T
            momentum = inertia @ motion.omega
            push = link.mass * (motion.point_bias(link.com) - self.links.gravity)
            moment = inertia @ motion.turn_bias + np.cross(motion.omega, momentum)
            columns = motion.jacobians(link.com)
            for i, (moved, turned) in columns.items():
                f[i] = f[i] - moved @ push - (0.0 if turned is None else turned @ moment)
                carried = None if turned is None else inertia @ turned
                for j, (other, also) in columns.items():
                    if j > i:
                        continue
                    M[i, j] = M[i, j] + link.mass * (moved @ other)
                    if carried is not None and also is not None:
                        M[i, j] = M[i, j] + carried @ also
        factor = cholesky(M)
        free = substitute(factor, f)
        if not self.links.cuts:
            return list(substitute_back(factor, free))
        A, gamma = self._rows(n)
        # columns of L^-1 A^T: their products are A M^-1 A^T
        spread = np.stack([substitute(factor, row) for row in A], axis=1)
        small = cholesky(spread.T @ spread)
        multipliers = substitute_back(small, substitute(small, spread.T @ free - gamma))
        return list(substitute_back(factor, free - spread @ multipliers))

    def _rows(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Rows A and right-hand side of A a = gamma for the cut joints' points."""
        rows, right = [], []
        for a, x, b, y in self.links.cuts:
            row = np.full((3, n), self.hy.expression(0.0))
            for sign, link, place in ((-1.0, a, x), (1.0, b, y)):
                for k, (moved, _) in self._motion(link).jacobians(place).items():
                    row[:, k] = row[:, k] + sign * moved
            apart = self._motion(b).point_bias(y) - self._motion(a).point_bias(x)
            rows.append(self.links.closed @ row)
            right.append(-self.links.closed @ apart)
        return np.concatenate(rows), np.concatenate(right)

    def _joint_forces(self) -> np.ndarray:
        hy, links = self.hy, self.links
        constant, waves = generalised(links)
        force = np.array([hy.expression(x) for x in constant])
        for link, first, motion in zip(links.links, self.first[:-1], self.motions, strict=True):
            if link.kind == "free":
                # given in body axes; the coordinates' velocity is in those of the world
                force[first : first + 3] = motion.R @ force[first : first + 3]
        for column, wave in waves:
            force = force + hy.sin(wave.rate * hy.time + wave.phase) * column
        for link, stiffness, damping, target in links.servos:
            k = self.first[link]
            pull = stiffness * (self.q[link][0] - target) + damping * self.v[link][0]
            force[k] = force[k] - pull
        for link, moment in links.moments:
            for k, (_, turned) in self._motion(link).jacobians(np.zeros(3)).items():
                if turned is not None:
                    force[k] = force[k] + turned @ moment
        for a, x, b, y, stiffness, damping, length in links.springs:
            ends = self._motion(a), self._motion(b)
            apart = ends[1].point(y) - ends[0].point(x)
            columns = [(-1.0, ends[0].jacobians(x)), (1.0, ends[1].jacobians(y))]
            v = np.concatenate(self.v)
            moving = sum(
                (sign * moved * v[k] for sign, own in columns for k, (moved, _) in own.items()),
                np.zeros(3),
            )
            now = hy.sqrt(apart @ apart)
            pull = (stiffness * (now - length) + damping * (apart @ moving) / now) / now * apart
            for sign, own in columns:
                for k, (moved, _) in own.items():
                    force[k] = force[k] - sign * (moved @ pull)
        return force


def cholesky(M: np.ndarray) -> np.ndarray:
    """Lower factor of a symmetric matrix whose lower half is given, symbolic."""
    n, L = len(M), np.zeros_like(M)
    root = lambda x: (x**0.5) if not isinstance(x, float | int) else math.sqrt(x)
    for j in range(n):
        L[j, j] = root(M[j, j] - L[j, :j] @ L[j, :j])
        for i in range(j + 1, n):
            L[i, j] = (M[i, j] - L[i, :j] @ L[j, :j]) / L[j, j]
    return L


def substitute(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solution of L x = b."""
    x = np.zeros_like(b)
    for i in range(len(b)):
        x[i] = (b[i] - L[i, :i] @ x[:i]) / L[i, i]
    return x


def substitute_back(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Solution of L^T x = b."""
    x = np.zeros_like(b)
    for i in reversed(range(len(b))):
        x[i] = (b[i] - L[i + 1 :, i] @ x[i + 1 :]) / L[i, i]
    return x


class HeyokaTaylor(Peer):
    """heyoka's Taylor integrator, one flight or as many as a vector of the processor holds."""

    name = "heyoka, Taylor series"
    packages = (("heyoka", "heyoka"),)
    how = (
        "Symbolic equations in coordinates of the spanning tree, multipliers of the cut joints by "
        "Cholesky factors; taylor_adaptive in compact mode, its order follows from the tolerance; "
        "batches by taylor_adaptive_batch of the recommended width, one after the other."
    )
    caveats = (
        "The equations are ours: heyoka has no model of mechanisms.",
        "Not stabilised: violations of the constraints grow with the integrator's error.",
        "Its compile time is that of one order.",
    )

    def unsupported(self, scene: Scene) -> str:
        return why_no_joint_forces(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return tolerances("taylor", range(4, 16))

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        began = time.perf_counter()
        equations = Equations(scene)
        x0 = equations.start(start(scene))
        hy, pairs = equations.hy, equations.system()
        program = hy.taylor_adaptive(
            pairs, x0, time=scene.t0, tol=setting.tolerance or 1e-6, compact_mode=True
        )
        look = self._looker(equations)
        seconds = time.perf_counter() - began

        def run() -> Outcome:
            program.time = scene.t0
            program.state[:] = x0
            states, steps, failure = np.full((len(times), len(x0)), np.nan), 0, ""
            for k, end in enumerate(times):
                outcome, _, _, count, *_ = program.propagate_until(float(end))
                steps += count
                if outcome != hy.taylor_outcome.time_limit:
                    failure = f"heyoka ended with {outcome}."
                    break
                states[k] = program.state
            n = len(equations.links.bodies)
            return looked_at(states, look, n, (steps, steps, 0), failure)

        return Prepared(run, seconds)

    def throughput(
        self, scene: Scene, states: State, t1: float, setting: Setting
    ) -> tuple[float, np.ndarray]:
        equations = Equations(scene)
        hy, lanes = equations.hy, equations.hy.recommended_simd_size()
        x0 = np.stack([equations.start(state) for state in starts(states)])
        # the last group is filled with flights that do not count
        groups = np.resize(x0, (math.ceil(len(x0) / lanes) * lanes, x0.shape[1]))
        groups = np.ascontiguousarray(groups.reshape(-1, lanes, x0.shape[1]).transpose(0, 2, 1))
        program = hy.taylor_adaptive_batch(
            equations.system(), groups[0], time=[scene.t0] * lanes,
            tol=setting.tolerance or 1e-6, compact_mode=True,
        )  # fmt: skip

        def fly() -> np.ndarray:
            ends = []
            for group in groups:
                program.set_time(scene.t0)
                program.state[:] = group
                program.propagate_until(t1)
                ends.append(program.state.T.copy())
            return np.concatenate(ends)[: len(x0)]

        ends, look = fly(), self._looker(equations)
        seconds = loop_seconds(fly, loops=1, repeats=3)
        return len(x0) / seconds, np.stack([look(x)[0] for x in ends])

    @staticmethod
    def _looker(equations: Equations) -> Callable[[np.ndarray], tuple[np.ndarray, float]]:
        """State -> centres of mass (n, 3) and the largest gap of a cut joint [m]."""
        variables = [*np.concatenate(equations.q), *np.concatenate(equations.v)]
        program = equations.hy.cfunc(equations.places(), variables, compact_mode=True)
        n = 3 * len(equations.links.bodies)

        def look(x: np.ndarray) -> tuple[np.ndarray, float]:
            numbers = program(np.ascontiguousarray(x))
            return numbers[:n].reshape(-1, 3), float(np.max(np.abs(numbers[n:]), initial=0.0))

        return look
