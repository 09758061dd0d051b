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
print(float(jnp.sum(run(x)[1])), "small_call" in run.lower(x).compile().as_text())
"""


def outcome(how: str) -> list[str]:
    environment = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    found = subprocess.run(
        [sys.executable, "-c", LOOP, how], capture_output=True, text=True, check=True,
        env=environment,
    )  # fmt: skip
    return found.stdout.split()


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
    assert (plain[1], quick[1]) == ("False", "True")
