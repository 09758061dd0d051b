"""Frame of a self-contained report page: style for light and dark, tables, embedded figures.

A page needs no network and no script. Cells of tables are HTML already: `text` escapes words.
"""

import base64
import html
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from ..checks.errors import SettingError, nearest_names
from ..files.netcdf import write_atomically
from .plot import content

# Media types of figures embedded in the page; a figure without one is a file beside it.
TYPES = {"png": "image/png", "svg": "image/svg+xml", "pdf": ""}

_STYLE = """
:root { color-scheme: light dark; --ink: #222; --paper: #fff; --faint: #666; --line: #ddd;
        --strong: #888; --bad: #a33000; --good: #00664a; }
@media (prefers-color-scheme: dark) { :root { --ink: #ddd; --paper: #16181c; --faint: #a0a4aa;
        --line: #33373d; --strong: #777; --bad: #ff9a70; --good: #5fd0a8; } }
body { font: 15px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--paper);
       max-width: 70rem; margin: 2rem auto; padding: 0 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.6rem; line-height: 1.25; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: 0.8rem 0; font-size: 0.86rem; }
th, td { padding: 0.25rem 0.6rem; text-align: right; border-bottom: 1px solid var(--line);
         vertical-align: top; font-variant-numeric: tabular-nums; }
th { border-bottom: 1px solid var(--strong); } caption { text-align: left; font-weight: 600; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td { white-space: nowrap; } td:first-child, td.text { white-space: normal; min-width: 9rem; }
td.text { overflow-wrap: anywhere; }
small { color: var(--faint); } summary { cursor: pointer; font-weight: 600; }
.verdict { border-left: 0.3rem solid var(--strong); padding-left: 0.8rem; }
.good { border-color: var(--good); } .bad { border-color: var(--bad); }
strong.good { color: var(--good); } strong.bad { color: var(--bad); }
figure { margin: 1.4rem 0; } figcaption { font-weight: 600; margin-bottom: 0.4rem; }
img { max-width: 56rem; width: 100%; box-sizing: border-box; background: #fff; border-radius: 4px; }
.wide { overflow-x: auto; } .side { display: grid; gap: 0 2rem; align-items: start;
  grid-template-columns: repeat(auto-fill, minmax(min(30rem, 100%), 1fr)); }
.side p { margin: 0.2rem 0; }
@media (max-width: 40rem) { body { margin: 1rem auto; padding: 0 0.7rem; } h1 { font-size: 1.3rem; }
  th, td { padding: 0.25rem 0.4rem; } td:first-child { min-width: 6.5rem; } td.text { min-width: 3.6rem; } }
@media print { :root { --ink: #000; --paper: #fff; } body { margin: 0; max-width: none; font-size: 9pt; }
  h2 { break-after: avoid; } table { font-size: 7.5pt; } th, td { padding: 0.15rem 0.4rem; }
  figure, tr, .side > div { break-inside: avoid; } .wide { overflow: visible; }
  .side { grid-template-columns: 1fr 1fr; gap: 0 1rem; } }
"""


class Picture(NamedTuple):
    """Figure of a page with its name and caption."""

    name: str
    words: str
    figure: Figure


def framed(title: str, parts: Iterable[str]) -> str:
    """HTML page with a title and parts that are HTML already; empty ones are left out."""
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{text(title)}</title>\n<style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


def check_format(format: str) -> None:
    """Raise SettingError for a format that figures of a page cannot have."""
    if format not in TYPES:
        raise SettingError(f"Figures cannot be '{format}'.{nearest_names(format, TYPES)}")


def drawn(
    pictures: Iterable[Picture], folder: Path, format: str, dpi: int, *, keep: bool = True
) -> tuple[list[Path], list[str]]:
    """Files of the figures in `folder`/figures, and the HTML that shows each.

    Args:
        pictures: figures, drawn one at a time.
        folder: folder of the page.
        format: "png", "svg" or "pdf"; a page refers to the files of pdf.
        dpi: resolution [dots per inch].
        keep: write files also of figures that are embedded.
    """
    paths, shown = [], []
    for name, words, figure in pictures:
        drawing, kind = content(figure, format, dpi), TYPES[format]
        if keep or not kind:
            path = folder / "figures" / f"{name}.{format}"
            paths.append(write_atomically(path, drawing))
        shown.append(_shown(f"{name}.{format}", words, drawing, kind))
    return paths, shown


def _shown(name: str, words: str, drawing: bytes, kind: str) -> str:
    said = text(words)
    if not kind:
        return f'<p><a href="figures/{text(name)}">{said}</a></p>'
    source = f"data:{kind};base64,{base64.b64encode(drawing).decode()}"
    return f'<figure><figcaption>{said}</figcaption><img alt="{said}" src="{source}"></figure>'


def write_page(
    title: str,
    head: Iterable[str],
    pictures: Iterator[Picture],
    tail: Iterable[str],
    path: str | os.PathLike[str],
    format: str,
    dpi: int,
) -> list[Path]:
    """Write a page with figures between its head and its tail, atomically; return its files' paths."""
    check_format(format)
    target = Path(path)
    paths, shown = drawn(pictures, target.parent, format, dpi, keep=False)
    figures = ["<h2>Figures</h2>", *(shown or ["<p>There is nothing to draw.</p>"])]
    page = framed(title, [f"<h1>{text(title)}</h1>", *head, *figures, *tail])
    return [write_atomically(target, page.encode()), *paths]


# --- pieces of a page


def text(value: Any) -> str:
    """Words with the characters escaped that HTML gives a meaning."""
    return html.escape(str(value))


def short(value: Any) -> str:
    """Text of plain data; long lists and long texts are cut."""
    if isinstance(value, list) and len(value) > 8:
        return f"{', '.join(short(x) for x in value[:3])}, ... ({len(value):,} in all)"
    if isinstance(value, list):
        return ", ".join(short(x) for x in value)
    words = f"{value:g}" if isinstance(value, float) else str(value)
    return words if len(words) <= 300 else f"{words[:300]} ..."


def number_text(value: float | None) -> str:
    """Number with four digits; empty for none, words for infinity."""
    if value is None or math.isnan(value):
        return ""
    if math.isinf(value):
        return "infinite" if value > 0 else "\N{MINUS SIGN}infinite"
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def verdict_text(words: str, good: bool | None) -> str:
    """Paragraph of a verdict with a mark for good or bad; None has none."""
    kind = "" if good is None else " good" if good else " bad"
    return f'<p class="verdict{kind}">{text(words)}</p>'


def html_table(
    head: list[str], rows: Iterable[list[str]], title: str = "", left: tuple[int, ...] = ()
) -> str:
    """HTML table of cells that are HTML already; columns in `left` are left-aligned words."""
    mark = lambda k: ' class="text"' if k in left else ""
    cells = lambda row, tag: "".join(f"<{tag}{mark(k)}>{x}</{tag}>" for k, x in enumerate(row))
    top = f"<thead><tr>{cells(head, 'th')}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    name = f"<caption>{title}</caption>" if title else ""
    return f'<div class="wide"><table>{name}{top}<tbody>{body}</tbody></table></div>'


def entries_table(entries: Iterable[tuple[str, Any]]) -> str:
    """HTML table of names and values; empty without entries."""
    rows = [[text(name), text(short(value))] for name, value in entries]
    return html_table(["", ""], rows, left=(1,)) if rows else ""


def section(title: str, content: str) -> str:
    """Section with a title; empty without content."""
    return f"<h2>{text(title)}</h2>{content}" if content else ""


def folded(title: str, content: str) -> str:
    """Section that the reader opens; empty without content."""
    return f"<details><summary>{text(title)}</summary>{content}</details>" if content else ""


def identity_table(attributes: Mapping[str, Any], left_out: Iterable[str]) -> str:
    """HTML table of the attributes of a dataset, without those left out."""
    skip = set(left_out)
    return entries_table((str(k), v) for k, v in attributes.items() if k not in skip and v != "")
