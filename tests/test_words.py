"""Docstrings are sentences that name their subject."""

import ast
from pathlib import Path

import stmuav_jax

ROOT = Path(stmuav_jax.__file__).parent
TREES = {path: ast.parse(path.read_text()) for path in sorted(ROOT.rglob("*.py"))}

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


def test_docstrings_name_their_subject():
    for path, tree in TREES.items():
        for name, docstring in documented(tree):
            words = docstring.split()
            place = f"{path}, {name}: {docstring.splitlines()[0]}"
            assert words[0].strip(",.:") not in NO_SUBJECT, place
            assert " ".join(words[:2]) not in NO_SUBJECT_PAIRS, place
            assert len(words) > 1, place


# Participles, pronouns, adverbs and prepositions, which name no thing, and how many bindings still have them
# alone: the number only falls.
NAMELESS = {
    "ahead", "again", "along", "apart", "aside", "asked", "away", "begun", "beside", "closer",
    "done", "drawn", "each", "ended", "far", "fine", "flown", "forced", "found", "given", "gone",
    "heard", "held", "here", "how", "kept", "known", "left", "looked", "made", "moved", "near",
    "off", "one", "own", "placed", "reached", "seen", "settled", "shown", "spoken", "still",
    "taken", "then", "there", "told", "turned", "wanted", "what", "which", "why", "words",
}  # fmt: skip
NAMELESS_BINDINGS = 10


def bound_names(tree):
    """Names of functions, arguments, classes and variables that a module binds."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield from (node.name, *(a.arg for a in (*node.args.args, *node.args.kwonlyargs)))
        elif isinstance(node, ast.ClassDef):
            yield node.name.lower()
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id


def test_names_are_nouns():
    names = (name.strip("_") for tree in TREES.values() for name in bound_names(tree))
    count = sum(name in NAMELESS for name in names)
    assert 0 < count <= NAMELESS_BINDINGS
