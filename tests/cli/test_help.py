"""Help of every command: it has examples that parse."""

import re
import shlex

import pytest

from stmuav_jax.cli import main as cli

# Every command, and those that a model's file changes.
COMMANDS = [[name] for name in cli.COMMANDS]
COMMANDS += [[name, "model.toml"] for name in ("trim", "estimate")]
COMMANDS += [["tune", "hold", "model.toml"], ["simulate", "uav_tracker"]]


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")


def examples(words: str) -> list[str]:
    """Command lines after "Example:" in a help text, up to the end of the sentence."""
    found = re.search(r"Examples?: (stmuav .*?)(?:\.\s|\.?\n\s*\n|\.?\s*$)", words, re.DOTALL)
    return [] if found is None else re.split(r";\s*", " ".join(found[1].split()))


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_has_examples_that_parse(words, capsys):
    assert cli.main([*words, "--help"]) == 0
    shown = capsys.readouterr().out
    found = examples(shown)
    assert found, shown[:400]
    for line in found:
        program, *given = shlex.split(line)
        assert (program, given[0]) == ("stmuav", words[0])
        name, _ = cli._parse_arguments(given)
        assert name == words[0]
    assert "default: None" not in shown


def test_examples_of_the_program_parse():
    found = examples(cli.ABOUT)
    assert len(found) >= 4
    for line in found:
        words = shlex.split(line)[1:]
        assert cli._parse_arguments(words)[0] == words[0]
