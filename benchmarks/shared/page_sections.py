"""Sections of documentation pages that a benchmark writes."""

from pathlib import Path

from stmuav_jax.io.netcdf import write_atomically


def write_section(page: Path, script: str, text: str) -> Path:
    """Write a section between its two comments in a page; a page that does not exist gets it alone.

    Args:
        page: path of the page in Markdown.
        script: path of the script in the repository, which names the comments.
        text: the section, with its heading.

    Raises:
        ValueError: the page lacks the comments.
    """
    begin, end = f"<!-- made by {script} -->\n", f"<!-- end of what {script} makes -->\n"
    section = f"{begin}\n{text.strip()}\n\n{end}"
    if page.exists():
        before, found, rest = page.read_text(encoding="utf-8").partition(begin)
        _, closed, after = rest.partition(end)
        if not (found and closed):
            raise ValueError(f"{page} lacks the comments between which {script} writes.")
        section = before + section + after
    return write_atomically(page, section.encode())
