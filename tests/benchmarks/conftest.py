"""Benchmark scripts run at their smallest size, in the process of the tests."""

import json
import runpy
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def run_script(tmp_path, monkeypatch) -> Iterator[Callable[..., dict[str, Any]]]:
    """Run of a script with these arguments, into `tmp_path`: its record, which has to be complete."""

    def run(name: str, *arguments: str, record: str = "") -> dict[str, Any]:
        argv = [f"{name}.py", *(arguments or ("--quick",)), "--results", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", argv)
        runpy.run_path(str(FOLDER / argv[0]), run_name="__main__")
        content = json.loads((tmp_path / f"{record or name}.json").read_text())
        assert {"commit", "dirty", "versions", "cores", "date"} <= set(content["environment"])
        return content

    yield run
    # the suite, which measures how long programs are compiled, keeps none
    jax.config.update("jax_enable_compilation_cache", True)
