"""Prose of the project's pages, as paragraphs without code, tables, formulas and links' addresses."""

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]


def texts() -> dict[str, str]:
    """Markdown of every page that people read, by its path: README, docs, notebooks' cells of text."""
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
    found = {str(page.relative_to(ROOT)): page.read_text(encoding="utf-8") for page in pages}
    for page in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(page.read_text(encoding="utf-8"))["cells"]
        words = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown"]
        found[f"notebooks/{page.name}"] = "\n\n".join(words)
    return found


def paragraphs(text: str) -> Iterator[str]:
    """Paragraphs, headings and items of lists, each on one line, of a page in Markdown."""
    text = re.sub(r"^( *)```.*?^\1```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->|<[^>]+>|\$\$.*?\$\$", " ", text, flags=re.DOTALL)
    text = re.sub(r"^\[[^\]]+\]: .*$", "", text, flags=re.MULTILINE)
    text = re.sub(r"^(#+ .*)$", r"\n\1\n", text, flags=re.MULTILINE)
    for block in re.split(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )|\n(?=\|)", text):
        lines = block.strip("\n").splitlines()
        # tables, and blocks that are code by their indentation
        if not lines or lines[0].startswith(("|", "    ")):
            continue
        words = " ".join(line.strip() for line in lines)
        words = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", words)
        yield re.sub(r"`[^`]*`|\$[^$]*\$", "CODE", words).strip("-*# ")


def main(folder: Path) -> None:
    """Write the paragraphs of every page to a file of its own, for programs that check prose."""
    folder.mkdir(parents=True, exist_ok=True)
    for page, text in texts().items():
        path = folder / f"{page.replace('/', '_')}.md"
        path.write_text("\n\n".join(paragraphs(text)) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
