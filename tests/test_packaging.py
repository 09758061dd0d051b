"""The source distribution has all files of the repository; the host's settings call the checks."""

import subprocess
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
HOST = ROOT / ".github"
FORMS = sorted(
    set((HOST / "ISSUE_TEMPLATE").glob("*.yml")) - {HOST / "ISSUE_TEMPLATE" / "config.yml"}
)


def tracked() -> list[str]:
    """Files of the repository; none where the tests were unpacked from a source distribution."""
    found = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return found.stdout.splitlines()


def test_source_distribution_has_every_tracked_file():
    given = PROJECT["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    # hatchling adds these two
    given = {*given, "pyproject.toml", ".gitignore"}
    assert all((ROOT / name).exists() for name in given)
    first = {path.partition("/")[0] for path in tracked()}
    assert first <= given


def test_base_install_has_no_optional_package():
    """What only an extra brings is imported where it is used (the wheel alone runs in .ci/run)."""
    names = lambda lines: {line.partition(">")[0].partition("[")[0] for line in lines}
    base = names(PROJECT["project"]["dependencies"])
    extras = {k: names(v) for k, v in PROJECT["project"]["optional-dependencies"].items()}
    optional = ("robots", "oracles", "cluster", "exchange")
    assert not base & set().union(*(extras[name] for name in optional))


def test_workflow_runs_the_checks():
    flow = yaml.safe_load((HOST / "workflows" / "ci.yml").read_text(encoding="utf-8"))
    steps = [step for job in flow["jobs"].values() for step in job["steps"]]
    assert ".ci/run" in [step.get("run") for step in steps]
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111
    # the lowest supported version of Python
    (version,) = [s["with"]["python-version"] for s in steps if "setup-python" in s.get("uses", "")]
    assert PROJECT["project"]["requires-python"] == f">={version}"


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_issue_forms_are_whole(path):
    form = yaml.safe_load(path.read_text(encoding="utf-8"))
    assert {"name", "description", "body"} <= set(form)
    ids = [field["id"] for field in form["body"]]
    assert len(set(ids)) == len(ids)
    assert all(field["attributes"]["label"] for field in form["body"])
    assert any(field.get("validations", {}).get("required") for field in form["body"])
