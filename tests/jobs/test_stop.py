"""Ctrl-C is neither lost nor raised where nobody can handle it."""

import os
import signal
import time

import pytest

from stmuav_jax.jobs.stop import stoppable


class Collected:
    """An object during whose end Ctrl-C comes."""

    reached_the_end = False

    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        Collected.reached_the_end = True


def test_a_signal_while_an_object_is_deleted(capfd):
    """Python prints and drops what `__del__` raises; the signal is raised behind it instead."""
    Collected.reached_the_end = False

    def run():
        with stoppable():
            Collected()
            time.sleep(5)

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run()
    assert time.monotonic() - began < 4
    assert Collected.reached_the_end
    assert capfd.readouterr().err == ""


def test_a_signal_that_is_heard_comes_once():
    with stoppable() as stop:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        stop.heard()
        time.sleep(1)
    assert stop.asked
