"""Studies and the code that computes them: samples of changed sources are not mixed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import stmuav_jax

# Runs with a copy of the package as sys.argv[1], a store, a number of samples, and perhaps a file of
# the package that is changed after the import.
RUN = """
import sys
sys.path[:0] = [sys.argv[1], sys.argv[4]]
import stmuav_jax
assert stmuav_jax.__file__.startswith(sys.argv[1])
from studies.toy import Toy
if len(sys.argv) > 5:
    with open(sys.argv[5], "a") as file:
        file.write("# changed again")
try:
    print(Toy(seed=7).run(sys.argv[2], int(sys.argv[3]), chunk=10, resume=True).describe())
except ValueError as error:
    print(type(error).__name__, error)
"""


def run(package: Path, store: Path, samples: int, *changed: Path) -> str:
    tests = Path(__file__).parents[1]
    words = [str(each) for each in (package, store, samples, tests, *changed)]
    done = subprocess.run(
        [sys.executable, "-P", "-c", RUN, *words],
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return done.stdout


@pytest.mark.slow
def test_a_store_is_not_extended_by_changed_sources(tmp_path):
    """The version of the package is the same; a comment is enough, and the first sources resume it."""
    package, store = tmp_path / "package", tmp_path / "study.zarr"
    folder = package / "stmuav_jax"
    shutil.copytree(
        Path(stmuav_jax.__file__).parent, folder, ignore=shutil.ignore_patterns("__pycache__")
    )
    assert "holds all 10 samples" in run(package, store, 10)
    file = folder / "mechanics" / "forces.py"
    source = file.read_text()
    file.write_text(source + "# changed")
    refusal = run(package, store, 20)
    assert refusal.startswith("FileError")
    assert "study.zarr was computed by other code" in refusal
    assert 'versions.sources is "' in refusal
    # sources that are changed under a process that has imported them are nobody's
    file.write_text(source)
    refusal = run(package, store, 20, file)
    assert refusal.startswith("SettingError")
    assert "forces.py was changed after this process imported stmuav_jax" in refusal
    file.write_text(source)
    assert "holds all 20 samples, 10 of them computed now" in run(package, store, 20)
