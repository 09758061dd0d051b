"""Programs to compare with, one module each; they import their packages only when used."""

from peers.adapter import Peer
from peers.exudyn_peer import ExudynPeer
from peers.heyoka_taylor import HeyokaTaylor
from peers.mujoco_c import MujocoC
from peers.mujoco_mjx import MujocoMjx
from peers.pinocchio_cpp import PinocchioCpp
from peers.pinocchio_python import PinocchioPython
from peers.scipy_dense import ScipyDense

PEERS: tuple[type[Peer], ...] = (
    PinocchioCpp, PinocchioPython, ScipyDense, MujocoC, MujocoMjx, ExudynPeer, HeyokaTaylor,
)  # fmt: skip
