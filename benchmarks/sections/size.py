"""How much of everything the suite runs: the measured run, and the smallest for tests."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Size:
    """Extents of all sections.

    Attributes:
        horizons: [s]. tolerances, stiff_tolerances: from coarse to fine. reference: tolerance of
            the reference run. methods, problems: how many.
        repeats: timed calls, as far as `budget` [s] allows.
        evaluations: in a loop, to time one.
        trajectories: in one batch, the middle one for all block sizes in `blocks`;
            peer_trajectories: those of peers.
        batch_tolerances: tried for `batch_error` [m] against runs at `tight`.
        loops: of the four-bar chains; run_loops: those that are integrated, too.
        flights: that take a step together, `group` of them side by side; compared: those of which
            errors are found; inner: steps in a call; machines: how many.
        gradient_horizon: [s]. parameters: of the gradient. span: of the hexacopter [s].
    """

    horizons: tuple[float, ...] = (0.5, 1.0)
    tolerances: tuple[float, ...] = tuple(10.0**-k for k in range(4, 13))
    stiff_tolerances: tuple[float, ...] = (1e-4, 1e-6, 1e-8)
    reference: float = 1e-13
    methods: int = 9
    problems: int = 9
    repeats: int = 5
    budget: float = 1.5
    evaluations: int = 5000
    trajectories: tuple[int, ...] = (64, 256, 1024)
    blocks: tuple[int, ...] = (16, 64, 256)
    peer_trajectories: int = 64
    batch_tolerances: tuple[float, ...] = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
    batch_error: float = 1e-6
    tight: float = 1e-11
    loops: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    run_loops: tuple[int, ...] = (1, 4, 16, 64)
    gradient_horizon: float = 0.3
    gradient_tolerances: tuple[float, ...] = (1e-6, 1e-8, 1e-10)
    parameters: int = 20
    flights: int = 4096
    compared: int = 256
    inner: int = 20
    group: int = 64
    step_repeats: int = 40
    machines: int = 3
    span: float = 2.0


FULL = Size()
ONE = Size(
    horizons=(0.02,), tolerances=(1e-4, 1e-6), stiff_tolerances=(1e-4,), reference=1e-9, methods=1,
    problems=1, repeats=1, budget=0.1, evaluations=10, trajectories=(2,), blocks=(2,),
    peer_trajectories=2, batch_tolerances=(1e-6,), tight=1e-9, loops=(1, 2), run_loops=(1,),
    flights=8, compared=4, inner=2, group=4, step_repeats=1, machines=1,
    gradient_horizon=0.02, gradient_tolerances=(1e-6,), parameters=2, span=0.02,
)  # fmt: skip
