"""Help of every command: it has examples that parse, whole sentences, and one text for one option."""

import ast
import dataclasses
import functools
import inspect
import itertools
import re
import shlex
import textwrap
from collections.abc import Iterator
from typing import Any, get_type_hints

import pytest

from stmuav_jax import cli
from stmuav_jax.commands.options import TEXTS

# Every command, and those that a model's file changes.
COMMANDS = [[name] for name in cli.COMMANDS]
COMMANDS += [[name, "model.toml"] for name in ("trim", "linearize", "estimate")]
COMMANDS += [["tune", "hold", "model.toml"], ["simulate", "uav_tracker"]]
# Options with another meaning in another command.
OTHER = {
    "t1": {TEXTS["t1"], TEXTS["duration"]},
    "to": {"panel angles", "states at the end"},
    "outputs": {"omega_x", "hinge.angle"},
}
# Openings with which a text is no description of a value.
FRAGMENTS = ("How ", "The first of", "Of ", "That ", "Their ", "Its ", "Instead ", "Go on", "What ")


@pytest.fixture(autouse=True)
def wide(monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")


def examples(words: str) -> list[str]:
    """Command lines after "Example:" in a help text, up to the end of the sentence."""
    found = re.search(r"Examples?: (stmuav .*?)(?:\.\s|\.?\n\s*\n|\.?\s*$)", words, re.DOTALL)
    return [] if found is None else re.split(r";\s*", " ".join(found[1].split()))


def options(words: list[str]) -> dict[str, str]:
    """Text of every option of a command that has one in `TEXTS` or in the source, by its name."""
    made = cli.COMMANDS[words[0]].options
    kind = made if isinstance(made, type) else made(words[1:])
    return dict(_texts(kind))


def _texts(kind: Any) -> Iterator[tuple[str, str]]:
    hints = get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        inner = getattr(hint, "__origin__", hint)
        if dataclasses.is_dataclass(inner):
            yield from _texts(inner) if field.name != "options" else ()
            continue
        notes = [getattr(note, "help", None) for note in getattr(hint, "__metadata__", ())]
        said = next((text for text in notes if text), None)
        yield field.name, said or _written(kind).get(field.name, "")


@functools.cache
def _written(kind: type) -> dict[str, str]:
    """Texts that stand below the fields in the source of a class and of its bases."""
    found = {}
    for each in kind.__mro__:
        if each is object or each.__module__ == "types":
            continue
        (body,) = ast.parse(textwrap.dedent(inspect.getsource(each))).body
        assert isinstance(body, ast.ClassDef)
        for field, text in itertools.pairwise(body.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                assert isinstance(field.target, ast.Name)
                found[field.target.id] = " ".join(ast.literal_eval(text.value).split())
    return found


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_has_examples_that_parse(words, capsys):
    assert cli.main([*words, "--help"]) == 0
    shown = capsys.readouterr().out
    found = examples(shown)
    assert found, shown[:400]
    for line in found:
        program, *given = shlex.split(line)
        assert (program, given[0]) == ("stmuav", words[0])
        name, _ = cli._read(given)
        assert name == words[0]
    assert "default: None" not in shown


def test_examples_of_the_program_parse():
    found = examples(cli.ABOUT)
    assert len(found) >= 4
    for line in found:
        words = shlex.split(line)[1:]
        assert cli._read(words)[0] == words[0]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_texts_of_options_are_sentences(words):
    for name, text in options(words).items():
        assert text.endswith("."), f"{name}: {text!r}"
        assert not text.startswith(FRAGMENTS), f"{name}: {text!r}"
        assert len(text.split()) > 1, f"{name}: {text!r}"


def test_one_option_has_one_text():
    every: dict[str, set[str]] = {}
    for words in COMMANDS:
        for name, text in options(words).items():
            every.setdefault(name, set()).add(re.sub(r"^\w+: ", "", text).lower())
    assert {"out", "figures", "params", "seed", "sun", "yaw"} <= set(every)
    for name, texts in every.items():
        assert len(texts) <= len(OTHER.get(name, (1,))), (name, texts)
        for part in OTHER.get(name, ()):
            assert any(part.lower() in text for text in texts), (name, part)


def test_every_shared_text_is_used():
    said = {text for words in COMMANDS for text in options(words).values()}
    assert set(TEXTS.values()) <= said
