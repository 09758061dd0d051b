"""Stored results belong to benchmarks that can be run again, and name the code that they measured."""

import json
from pathlib import Path

import all as everything
import pytest
from shared import record


def test_every_result_belongs_to_a_benchmark_that_all_runs():
    stored = {path.stem for path in record.RESULTS.glob("*.json")}
    assert stored == set(everything.BENCHMARKS)
    scripts = {everything.FOLDER / script for script, *_ in everything.BENCHMARKS.values()}
    assert all(script.exists() for script in scripts)


@pytest.fixture
def repository(monkeypatch, tmp_path: Path) -> Path:
    """A repository of its own with one file of the package, which is committed."""
    monkeypatch.setattr(record, "ROOT", tmp_path)
    (tmp_path / "stmuav_jax").mkdir()
    (tmp_path / "benchmarks" / "results").mkdir(parents=True)
    (tmp_path / "stmuav_jax" / "body.py").write_text("first")
    commit_all()
    return tmp_path


def commit_all() -> None:
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    commands = (("init", "-q"), ("add", "."), (*author, "commit", "-q", "-m", "code"))
    assert None not in [record.run_git(*words) for words in commands]


def test_a_result_names_its_commit_and_whether_the_code_was_changed(repository):
    results = repository / "benchmarks" / "results"
    path = record.write_record("one", {"what": "a test"}, results)
    environment = json.loads(path.read_text())["environment"]
    assert {"versions", "cpu", "cores", "date"} <= set(environment)
    assert environment["commit"] == record.run_git("rev-parse", "HEAD")
    # the result itself is no change of the code
    assert not environment["dirty"]
    assert everything.describe_age(path) == ""
    assert "no result" in everything.describe_age(results / "two.json")
    # nor is its commit
    commit_all()
    assert everything.describe_age(path) == ""
    (repository / "stmuav_jax" / "body.py").write_text("second")
    commit_all()
    assert "other code" in everything.describe_age(path)
    (repository / "stmuav_jax" / "body.py").write_text("third")
    path = record.write_record("one", {}, results)
    assert json.loads(path.read_text())["environment"]["dirty"]
    assert "with changes" in everything.describe_age(path)


def test_parts_that_no_script_measures_any_more_stay_as_they_are(monkeypatch, tmp_path):
    monkeypatch.setattr(everything, "has_code_of", lambda commit: True)
    clean = {"commit": "a" * 40, "dirty": False}
    path = tmp_path / "failure.json"
    for name, is_due in (("alignment", False), ("deciding", True)):
        parts = {name: {**clean, "dirty": True}}
        path.write_text(json.dumps({"environment": clean, "measured": parts}))
        assert bool(everything.describe_age(path)) == is_due
