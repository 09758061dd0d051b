"""Native loops, each case in a process of its own: the option counts once per process."""

import os
import subprocess
import sys

import pytest

import stmuav_jax as stm
from stmuav_jax.algebra import native

# XLA marks the functions that it compiles natively as small calls.
LOOP = """
import sys
import jax, jax.numpy as jnp
import stmuav_jax as stm
if sys.argv[1] == "native":
    stm.algebra.use_native_loops()
jax.config.update("jax_enable_x64", True)

def body(at):
    i, x = at
    return i + 1, jnp.sin(x) * jnp.flip(x) + jnp.cumsum(x) / 300

run = jax.jit(lambda x: jax.lax.while_loop(lambda at: at[0] < 9, body, (0, x)))
x = jnp.linspace(0.0, 1.0, 300)
print(float(jnp.sum(run(x)[1])), run.lower(x).compile().as_text().count("small_call"))
"""


def outcome(how: str, source: str = LOOP) -> list[float]:
    """Numbers that a program prints; it may take 20 times as long as on a quiet machine."""
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    found = subprocess.run(
        [sys.executable, "-c", source, how], capture_output=True, text=True, check=True,
        env=environment, timeout=600,
    )  # fmt: skip
    return [float(number) for number in found.stdout.split()]


def test_the_option_is_added_to_what_is_there(monkeypatch):
    monkeypatch.setattr(native, "_backend_has_started", lambda: False)
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1 --xla_backend_extra_options=b=2 --xla_c=3")
    stm.algebra.use_native_loops()
    expected = (
        "--xla_a=1 --xla_c=3 "
        "--xla_backend_extra_options=b=2,xla_cpu_small_while_loop_byte_threshold=10000000"
    )
    assert os.environ["XLA_FLAGS"] == expected
    stm.algebra.use_native_loops()
    assert os.environ["XLA_FLAGS"] == expected


def test_too_late_is_said(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1")
    monkeypatch.setattr(native, "_backend_has_started", lambda: True)
    with pytest.raises(stm.SettingError, match="before JAX computes anything"):
        stm.algebra.use_native_loops()
    assert os.environ["XLA_FLAGS"] == "--xla_a=1"


def test_the_loop_is_one_native_function():
    plain, quick = outcome("plain"), outcome("native")
    assert plain[0] == quick[0]
    assert plain[1] == 0
    assert quick[1] > 0


UNKNOWN = """
import warnings
import jax, jax.numpy as jnp
import stmuav_jax as stm
from stmuav_jax.algebra import native
from stmuav_jax.algebra.linalg import cholesky
native._OPTION = "xla_cpu_an_option_of_no_version"
stm.algebra.use_native_loops()
S = 2.0 * jnp.eye(3)
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    L = jax.jit(cholesky)(S), jax.jit(lambda S: cholesky(S + S))(S)
said = [str(x.message) for x in caught if native._OPTION in str(x.message)]
print(len(said), float(L[0][0, 0] ** 2), float(L[1][0, 0] ** 2), int(native.native_loops()))
"""


def test_an_option_that_xla_does_not_know_is_said_once():
    """Programs are those without native loops then; what is computed is right."""
    assert outcome("native", UNKNOWN) == pytest.approx([1, 2, 4, 0], rel=1e-6)


# Two implicit methods on ten nonlinear oscillators; their loops over stages hold no library call.
IMPLICIT = """
import sys
import diffrax, jax, jax.numpy as jnp
import stmuav_jax as stm
if sys.argv[1] == "native":
    stm.algebra.use_native_loops()
jax.config.update("jax_enable_x64", True)
from stmuav_jax.dynamics.integration.esdirk import NonDenseESDIRK

def field(t, y, args):
    x, v = y[:10], y[10:]
    return jnp.concatenate([v, 50 * ((1 - x**2) * v - jnp.cos(t) * x + 0.1 * jnp.flip(x))])

for solver in (stm.Rodas5P(), NonDenseESDIRK(diffrax.Kvaerno5(), 1e-8, 1e-8, 20)):
    run = jax.jit(lambda y: diffrax.diffeqsolve(
        diffrax.ODETerm(field), solver, 0.0, 1.0, 1e-3, y, adjoint=diffrax.ForwardMode(),
        stepsize_controller=diffrax.PIDController(rtol=1e-8, atol=1e-8)).ys[-1])
    y = jnp.concatenate([jnp.linspace(1.5, 2.0, 10), jnp.zeros(10)])
    print(*run(y)[:2], run.lower(y).compile().as_text().count("xla_cpu_small_call"))
"""


@pytest.mark.slow
def test_implicit_methods_in_native_loops():
    """Equal results in a bounded time; the loops around LAPACK's calls stay what they are."""
    plain, quick = outcome("plain", IMPLICIT), outcome("native", IMPLICIT)
    for k in (0, 3):
        assert plain[k : k + 2] == pytest.approx(quick[k : k + 2], rel=1e-9)
        assert quick[k + 2] > plain[k + 2]
