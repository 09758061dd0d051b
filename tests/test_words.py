"""Docstrings are sentences that name their subject; pages use the field's words in short sentences."""

import ast
import re
from pathlib import Path

import prose
import pytest

import stmuav_jax

ROOT = Path(stmuav_jax.__file__).parent
MODULES = sorted(ROOT.rglob("*.py"))

# With these a sentence has no subject: its reader does not know what is spoken of.
NO_SUBJECT = {
    "Of", "What", "Where", "Whether", "Which", "How", "When", "Until", "As", "Like", "It", "They",
    "That", "Those",
}  # fmt: skip
NO_SUBJECT_PAIRS = {"The same", "By how"}


def documented(tree: ast.Module) -> list[tuple[str, str]]:
    """Name and docstring of a module, its classes and its functions."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            words = ast.get_docstring(node)
            if words:
                found.append((getattr(node, "name", "the module"), words))
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_docstrings_name_their_subject(path):
    for name, words in documented(ast.parse(path.read_text())):
        first = words.split()
        opening = first[0].strip(",.:")
        assert opening not in NO_SUBJECT, f"{name}: {words.splitlines()[0]}"
        assert " ".join(first[:2]) not in NO_SUBJECT_PAIRS, f"{name}: {words.splitlines()[0]}"
        assert len(words.split()) > 1, f"{name}: {words}"


# --- pages and help texts

# Words of this project's own, and those of the field's books that stand in their place. They are looked for
# in prose, without regard to case.
REPLACED = {
    r"small motions?": "linearisation",
    r"Hautus'?s? measures": "the PBH test",
    r"flyers?": "flying machine",
    r"cut joints?": "loop-closing joint",
    r"fine samples?": "completed sample",
    r"against the body": "relative to the body",
    r"step control": "step-size control",
    r"motors that lag": "motor dynamics",
    r"steps allowed": "largest number of steps",
    r"how many runs": "number of runs",
    r"the first of them": "first seed",
    r"go(?:es)? on with": "continue, resume",
    r"nothing is done again": "only ... are evaluated again",
    r"cannot stand": "infeasible, no posture",
    r"gust moments?": "rotational gust components",
    r"both ways round": "in either direction",
    r"loses? digits": "lose accuracy",
    r"samples that fail kept": "failed samples are kept",
    r"and calls that": "its stated standard deviation is",
    r"how honestly": "consistency",
    r"what has to be chosen": "options",
}
# Words that may follow themselves.
DOUBLED = ("that that", "had had", "rad rad")
# Largest number of words in a sentence of the pages.
LONGEST = 45


@pytest.mark.parametrize("page", prose.texts())
def test_pages_use_the_words_of_the_field(page):
    for paragraph in prose.paragraphs(prose.texts()[page]):
        check_terms(paragraph)


@pytest.mark.parametrize("page", prose.texts())
def test_sentences_of_pages_are_short(page):
    for paragraph in prose.paragraphs(prose.texts()[page]):
        for sentence in prose.sentences(paragraph):
            assert len(sentence.split()) <= LONGEST, sentence


def test_help_uses_the_words_of_the_field():
    """The texts below fields and those of commands, as they stand in the source."""
    for path in sorted((ROOT / "commands").rglob("*.py")):
        tree = ast.parse(path.read_text())
        found = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)]
        for words in found:
            if isinstance(words, str) and " " in words:
                check_terms(" ".join(words.split()))


def check_terms(words: str) -> None:
    twice = re.search(r"\b([a-z]+) \1\b", words)
    assert twice is None or twice[0] in DOUBLED, words
    for term, better in REPLACED.items():
        hit = re.search(rf"\b{term}\b", words, re.IGNORECASE)
        assert hit is None, f"'{hit and hit[0]}' is '{better}' in the field's words: {words}"


def test_sentences_are_told_apart():
    page = "# Head\n\nOne `a. B` two ([x](y.md)). Three:\n- four; five.\n\n```\nCode. Here\n```\n\n| a | b |\n"
    found = [s for p in prose.paragraphs(page) for s in prose.sentences(p)]
    assert found == ["Head", "One CODE two (x).", "Three:", "four; five."]
