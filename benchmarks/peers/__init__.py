"""Programs to compare with, one module each; they import their packages only when used."""

from adapter import Peer

from .exudyn_peer import ExudynPeer
from .mujoco_c import MujocoC
from .mujoco_mjx import MujocoMjx
from .pinocchio_cpp import PinocchioCpp
from .pinocchio_python import PinocchioPython
from .scipy_dense import ScipyDense

PEERS: tuple[type[Peer], ...] = (
    PinocchioCpp,
    PinocchioPython,
    ScipyDense,
    MujocoC,
    MujocoMjx,
    ExudynPeer,
)
