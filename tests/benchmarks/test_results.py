"""Committed results can be traced: the commit that each names is in the history.

Also the guard that keeps it so: results are not overwritten from a tree with changes.
"""

import json
from pathlib import Path

import all as everything
import pytest
from shared import record

FOLDER = Path(__file__).parents[2] / "benchmarks"

RESULTS = sorted(record.RESULTS.glob("*.json"))

# Results whose commit is not in the history, each with the reason. No other may come.
KNOWN_STALE: dict[str, str] = {}

# Benchmarks that have not been run on a quiet machine yet. A name leaves with its first result.
NOT_RUN_YET: set[str] = set()


def lost(path: Path) -> set[str]:
    """Commits that a result or its parts name whose code no commit of the history has."""
    content = json.loads(path.read_text())
    parts = [content["environment"], *content.get("measured", {}).values()]
    return {part["commit"] for part in parts if record.traced(part) is None}


@pytest.fixture(scope="module")
def history() -> None:
    """Skip where there is no history to look into."""
    if record.git("rev-parse", "--is-inside-work-tree") != "true":
        pytest.skip("There is no git repository here (a source archive has none).")
    if record.git("rev-parse", "--is-shallow-repository") == "true":
        pytest.skip("The repository is a shallow clone: most of its history is missing.")


@pytest.mark.parametrize("path", RESULTS, ids=lambda p: p.stem)
@pytest.mark.usefixtures("history")
def test_the_commit_of_every_result_is_in_the_history(path):
    names = lost(path)
    if path.stem in KNOWN_STALE:
        assert names, f"{path.name} is traceable again: take it out of KNOWN_STALE."
    else:
        assert not names, f"{path.name} names commits that are not in the history: {names}."


def test_the_list_of_stale_results_names_results():
    assert set(KNOWN_STALE) <= {path.stem for path in RESULTS}


def test_every_result_belongs_to_a_benchmark_that_all_runs():
    assert {path.stem for path in RESULTS} == set(everything.BENCHMARKS) - NOT_RUN_YET
    scripts = {FOLDER / script for script, *_ in everything.BENCHMARKS.values()}
    assert all(script.exists() for script in scripts)


@pytest.fixture
def tree(monkeypatch, tmp_path):
    """A stand-in for the repository: a results folder, and what is said to have changed."""
    changed: list[str] = []
    monkeypatch.setattr(record, "ROOT", tmp_path)
    monkeypatch.setattr(record, "RESULTS", tmp_path / "benchmarks" / "results")
    monkeypatch.setattr(record, "changes", lambda: list(changed))
    monkeypatch.setattr(record, "elsewhere", lambda: "")
    monkeypatch.delenv(record.ALLOW, raising=False)
    return changed


def test_results_are_written_from_a_clean_tree(tree):
    path = record.write("one", {"what": "a test"}, record.RESULTS)
    about = json.loads(path.read_text())["environment"]
    assert (about["dirty"], about["changed"], about["allow_dirty"]) == (False, [], False)


def test_results_are_not_overwritten_from_a_tree_with_changes(tree, tmp_path):
    path = record.write("one", {"what": "before"}, record.RESULTS)
    tree.append("stmuav_jax/dynamics/trajectory.py")
    with pytest.raises(record.DirtyTreeError, match=r"trajectory\.py.*build/results/one\.json"):
        record.write("one", {"what": "after"}, record.RESULTS)
    assert json.loads(path.read_text())["what"] == "before"
    # nothing is lost, and another folder takes it
    kept = tmp_path / "build" / "results" / "one.json"
    assert json.loads(kept.read_text())["what"] == "after"
    assert record.write("one", {"what": "after"}, tmp_path / "mine").exists()


def test_dirty_results_are_written_where_that_is_asked_for_and_say_so(tree, monkeypatch):
    tree.append("stmuav_jax/dynamics/trajectory.py")
    monkeypatch.setenv(record.ALLOW, "1")
    about = json.loads(record.write("one", {}, record.RESULTS).read_text())["environment"]
    assert (about["dirty"], about["changed"], about["allow_dirty"]) == (True, tree, True)


def test_results_of_a_package_from_elsewhere_are_refused(tree, monkeypatch):
    monkeypatch.setattr(record, "elsewhere", lambda: "/usr/lib/python3/site-packages")
    with pytest.raises(record.DirtyTreeError, match="site-packages"):
        record.write("one", {}, record.RESULTS)


@pytest.mark.usefixtures("history")
def test_what_benchmarks_write_is_no_change_of_the_code(monkeypatch, tmp_path):
    """In a repository of its own: a result, a page and a figure do not make the tree dirty."""
    monkeypatch.setattr(record, "ROOT", tmp_path)
    for name in ("stmuav_jax/a.py", "benchmarks/results/r.json", "docs/benchmarks.md"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("before")
    author = ("-c", "user.name=a", "-c", "user.email=a@example.org")
    for call in (("init", "-q"), ("add", "."), (*author, "commit", "-q", "-m", "first")):
        assert record.git(*call) is not None
    first = record.commit()
    assert record.changes() == []
    (tmp_path / "benchmarks/results/r.json").write_text("after")
    (tmp_path / "docs/benchmarks.md").write_text("after")
    assert record.changes() == []
    assert record.git("add", ".") is not None
    assert record.git(*author, "commit", "-q", "-m", "results") is not None
    assert record.moved(first, *record.MEASURED) == 0
    (tmp_path / "stmuav_jax/a.py").write_text("after")
    (tmp_path / "stmuav_jax/b.py").write_text("new")
    assert record.changes() == ["stmuav_jax/a.py", "stmuav_jax/b.py"]
    assert record.git("add", ".") is not None
    assert record.git(*author, "commit", "-q", "-m", "code") is not None
    assert record.moved(first, *record.MEASURED) == 1
    assert not record.in_history("f" * 40)
    # another commit with the same files of the package and the benchmarks is as good
    about = {"commit": "f" * 40}
    assert record.traced(about) is None
    assert record.traced({**about, "sources": record.sources()}) == record.commit()
    assert record.traced({**about, "sources": record.sources(first)}) == first
    assert record.traced({"commit": first}) == first


def result(folder: Path, name: str, **about: object) -> None:
    """A result file with an environment."""
    told = {"commit": "a" * 40, "dirty": False, **about}
    (folder / f"{name}.json").write_text(json.dumps({"environment": told}))


@pytest.mark.parametrize(
    ("about", "since", "reason"),
    [
        ({}, 0, ""),
        ({}, 3, "3 commits ago"),
        ({}, None, "not in the history"),
        ({"dirty": True}, 0, "with changes"),
        ({"package_from_elsewhere": True}, 0, "with changes"),
    ],
)
def test_what_is_run_again(about, since, reason, monkeypatch, tmp_path):
    monkeypatch.setattr(everything, "moved", lambda *_: since)
    monkeypatch.setattr(
        everything, "traced", lambda part: since if since is None else part["commit"]
    )
    assert "no result" in everything.why_again("stiff", tmp_path)
    result(tmp_path, "stiff", **about)
    assert reason in everything.why_again("stiff", tmp_path)
    assert bool(everything.why_again("stiff", tmp_path)) == bool(reason)


def test_finished_parts_are_not_run_again(monkeypatch, tmp_path):
    told = {"commit": "a" * 40, "dirty": False}
    for name, again in (("alignment", False), ("deciding", True)):
        parts = {"environment": told, "measured": {name: {**told, "dirty": True}}}
        (tmp_path / "failure.json").write_text(json.dumps(parts))
        monkeypatch.setattr(everything, "moved", lambda *_: 0)
        monkeypatch.setattr(everything, "traced", lambda part: part["commit"])
        assert bool(everything.why_again("failure", tmp_path)) == again
