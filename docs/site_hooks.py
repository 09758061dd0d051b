"""Hooks of mkdocs: pages of the site that are made from what the repository has anyway.

The API pages follow from the lists of public names (`__init__.pyi`), the tutorials from the stored
notebooks, formulas from LaTeX in fences as GitHub draws it. Formulas become MathML, which browsers
draw themselves, so that a page needs no script and no font from elsewhere.
"""

import ast
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "stmuav_jax"
# Pages that lie outside of docs/, and their names in the site.
OUTSIDE = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "benchmarks/README.md": "benchmarking.md",
    "notebooks": "notebooks",
}
LINK = re.compile(r"(!?)\[([^\]\[]*)\]\(([^)#\s]+)(#[^)]*)?\)")
REFERENCE = re.compile(r"^\[([^\]]+)\]: (\S+)$", re.MULTILINE)
PICTURE = re.compile(r'(<img\b[^>]*\bsrc="([^"]+)"[^>]*>)')
NAME = re.compile(r"<code>([\w/.:-]+)</code>")
DATE = re.compile(r"(?<=<td>)(\d{4}-\d\d-\d\d)(?=</td>)")
# a dollar before a blank, or after one, is money
IN_A_LINE = re.compile(r"(?<![\\$\w])\$(?=[^\s$])([^$\n]*(?:\n(?!\n)[^$\n]*)?[^\s$])\$(?![\w$])")
FORMULA = re.compile(r"^```math\n(.*?)^```$|^\$\$(.*?)\$\$$", re.MULTILINE | re.DOTALL)


# --- API pages


def rooms() -> list[str]:
    """Sub-namespaces with public names, in the order of the alphabet."""
    return sorted(stub.parent.name for stub in PACKAGE.glob("*/__init__.pyi"))


def public_names(room: str) -> dict[str, list[str]]:
    """Public names of a sub-namespace ("" for the root) by the module that defines them."""
    found: dict[str, list[str]] = {}
    stub = PACKAGE / room / "__init__.pyi"
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level == 1 and node.module is None:
            names = [alias.asname or alias.name for alias in node.names]
            for name in names:
                if not (not room and name in rooms()):
                    found.setdefault(".".join(p for p in (room, name) if p), []).append(name)
        elif isinstance(node, ast.ImportFrom):
            source = PACKAGE / room
            for _ in range(node.level - 1):
                source = source.parent
            module = ".".join([*source.relative_to(PACKAGE).parts, node.module or ""])
            names = [alias.asname or alias.name for alias in node.names]
            found.setdefault(module, []).extend(names)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.setdefault("", []).append(node.target.id)
    return found


def _about(module: str) -> str:
    """First sentence of a module's docstring, without the floor on which it stands."""
    path = PACKAGE.joinpath(*module.split("."))
    source = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    words = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8"))) or ""
    first = words.split("\n\n")[0].replace("\n", " ")
    return re.sub(r" Floor \d+[^.]*\.", "", first)


def api_page(room: str) -> str:
    """Text of the API page of a sub-namespace, or of the root."""
    place = ".".join(p for p in ("stmuav_jax", room) if p)
    short = f"stm.{room}" if room else "stm"
    found = public_names(room)
    described = {name for module, names in found.items() if module for name in names}
    links = [f"[`{name}`][{place}.{name}]" for name in sorted(described, key=str.lower)]
    # a search finds the names of the root before those of the same words elsewhere
    lines = [] if room else ["---", "search: {boost: 4}", "---", ""]
    lines += [f"# `{short}`", "", _about(room) if room else "Names at the root of the package.", ""]
    lines += ["\n".join(links), "{ .names }", ""]
    for module, names in found.items():
        if module == "":
            lines += ["## Version", "", "`stmuav_jax.__version__` is the version as text.", ""]
            continue
        lines += [f"## {_about(module).removesuffix('.')}", ""]
        for name in sorted(names, key=str.lower):
            lines += [f"::: {place}.{name}", "    options:", "      heading_level: 3", ""]
    return "\n".join(lines)


def api_index() -> str:
    """Text of the page that leads to the API pages."""
    lines = [
        "# API reference", "",
        "Every public name is at the root, `import stmuav_jax as stm`, or in one of the "
        "sub-namespaces. Names that are found nowhere here are internal and may change.", "",
        "| namespace | what is in it |", "| --- | --- |",
        "| [`stm`](root.md) | what most programs need |",
    ]  # fmt: skip
    lines += [f"| [`stm.{room}`]({room}.md) | {_about(room)} |" for room in rooms()]
    return "\n".join([*lines, ""])


def api_pages() -> dict[str, str]:
    """Texts of all API pages by their paths in the site."""
    pages = {f"api/{room}.md": api_page(room) for room in rooms()}
    return {"api/index.md": api_index(), "api/root.md": api_page(""), **pages}


# --- other pages


def notebook_pages() -> Iterator[tuple[str, str | bytes]]:
    """Paths and contents of the tutorials: a page for each notebook, and its pictures."""
    from nbconvert import MarkdownExporter

    exporter = MarkdownExporter()
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text, resources = exporter.from_filename(str(path))
        for name, content in resources["outputs"].items():
            text = text.replace(f"![png]({name})", f"![figure]({path.stem}_{name})")
            yield f"notebooks/{path.stem}_{name}", content
        yield f"notebooks/{path.stem}.md", _outputs_as_text(text)


def _outputs_as_text(text: str) -> str:
    """Text of a notebook whose outputs, indented by four blanks, are fenced: they are no Python."""
    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    indented = re.compile(r"((?:^    .*\n|^\s*\n)+)", re.MULTILINE)
    parts[::2] = [indented.sub(_output, part) for part in parts[::2]]
    return "".join(parts)


def _output(match: re.Match[str]) -> str:
    lines = match[1].split("\n")
    if not any(line.strip() for line in lines):
        return match[1]
    body = "\n".join(line[4:].rstrip() for line in lines).strip("\n")
    body = re.sub(r"\n{3,}", "\n\n", body)  # between the outputs of one cell
    return f"\n\n```text\n{body}\n```\n\n"


def validation_page() -> str:
    """Text of the page on validation, with the list of what the tests claim at its end."""
    lines = [
        (ROOT / "docs" / "validation.md").read_text(encoding="utf-8"),
        "## Tests by subject",
        "",
    ]
    titles = {"published": "Published problems", "oracles": "Independent programs", "laws": "Laws",
              "hard": "Hard cases"}  # fmt: skip
    for folder, title in titles.items():
        lines += [f"### {title}", ""]
        for path in sorted((ROOT / "tests" / folder).glob("test_*.py")):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            about = (ast.get_docstring(tree) or "").split("\n\n")[0].replace("\n", " ")
            lines += [f"**{about}** `tests/{folder}/{path.name}`", ""]
            for node in tree.body:
                if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                    lines.append(f"- {_about_test(node)}")
            lines.append("")
    return "\n".join(lines)


def _about_test(node: ast.FunctionDef) -> str:
    """What a test's name says, and what the first paragraph of its docstring adds."""
    name = node.name.removeprefix("test_").replace("_", " ")
    words = (ast.get_docstring(node) or "").split("\n\n")[0].replace("\n", " ")
    return f"{name[:1].upper()}{name[1:]}. {words}".rstrip()


def outside_pages() -> Iterator[tuple[str, str | bytes]]:
    """Paths and contents of the pages that lie outside of docs/."""
    for source, target in OUTSIDE.items():
        if source.endswith(".md"):
            yield target, (ROOT / source).read_text(encoding="utf-8")
    yield from notebook_pages()


def _title(path: str) -> str:
    """Title of a page of the site, by its path in the repository."""
    text = (ROOT / path).read_text(encoding="utf-8")
    return re.findall(r"^# (.+)$", text, re.MULTILINE)[0]


def links_in_site(text: str, source: str) -> str:
    """Text of a page whose links lead to places in the site, or are plain words.

    A link whose words are the name of the page's file gets the title of that page.

    Args:
        text: text of the page.
        source: path of the page in the repository, as it was written.
    """
    here = posixpath.dirname(source)

    def target(link: str) -> str | None:
        if re.match(r"\w+:", link):
            return link
        path = posixpath.normpath(posixpath.join(here, link))
        if path.startswith("notebooks/"):
            path = f"docs/{path.removesuffix('.ipynb')}" + ".md" * path.endswith(".ipynb")
        elif path in OUTSIDE:
            path = f"docs/{OUTSIDE[path]}"
        if not path.startswith("docs/"):
            return None
        start = here if here.startswith("docs") else posixpath.join("docs", here)
        if source in OUTSIDE:
            start = posixpath.dirname(f"docs/{OUTSIDE[source]}")
        return posixpath.relpath(path, start)

    def inline(match: re.Match[str]) -> str:
        picture, words, link, anchor = match.groups()
        found = target(link)
        if found is None:
            return words
        if words.endswith(".md") and posixpath.basename(words) == posixpath.basename(link):
            words = _title(posixpath.normpath(posixpath.join(here, link)))
        return f"{picture}[{words}]({found}{anchor or ''})"

    for label, link in REFERENCE.findall(text):
        if target(link) is None:
            text = text.replace(f"[{label}]: {link}", "").replace(f"[{label}]", f"`{label}`")
    return LINK.sub(inline, text)


def with_pictures_to_open(html: str) -> str:
    """HTML of a page whose pictures lead to themselves, so that a click shows them whole."""
    parts = re.split(r"(<a\b.*?</a>)", html, flags=re.DOTALL)
    parts[::2] = [PICTURE.sub(r'<a href="\2">\1</a>', part) for part in parts[::2]]
    return "".join(parts)


def with_whole_names(html: str) -> str:
    """HTML of a page whose tables break long names at dots and underscores, short ones and dates nowhere."""

    def name(found: re.Match[str]) -> str:
        if len(found[1]) < 20:
            return f'<code class="whole">{found[1]}</code>'
        return "<code>" + re.sub(r"(::|[/._](?=\w))", r"\1<wbr>", found[1]) + "</code>"

    def table(text: str) -> str:
        return DATE.sub(r'<span class="whole">\1</span>', NAME.sub(name, text))

    parts = re.split(r"(<table>.*?</table>)", html, flags=re.DOTALL)
    parts[1::2] = [table(part) for part in parts[1::2]]
    return "".join(parts)


def _mathml(match: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    return f'<div class="formula">{convert((match[1] or match[2]).strip(), display="block")}</div>'


def with_formulas(text: str) -> str:
    """Text of a page whose LaTeX, in fences or between dollars, is MathML; code stays as it is."""
    from latex2mathml.converter import convert

    parts = re.split(r"(^```.*?^```$|`[^`]+`)", FORMULA.sub(_mathml, text), flags=re.M | re.S)
    parts[::2] = [
        IN_A_LINE.sub(lambda found: f"<span>{convert(found[1].strip())}</span>", part)
        for part in parts[::2]
    ]
    return "".join(parts)


def _local(output: str, here: str) -> str:
    """HTML of a page in which the one script from elsewhere is the site's own copy."""
    place = posixpath.relpath("iframe-worker.js", posixpath.dirname(here) or ".")
    return output.replace("https://unpkg.com/iframe-worker/shim", place)


def _repository_path(uri: str) -> str:
    for source, target in OUTSIDE.items():
        if uri == target:
            return source
    return uri if uri.startswith("notebooks/") else f"docs/{uri}"


# --- what mkdocs calls


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made to those of docs/."""
    from mkdocs.structure.files import File

    for path, content in [*api_pages().items(), *outside_pages()]:
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Turn links to files outside of the site into words, and formulas into MathML."""
    uri = page.file.src_uri
    if uri == "validation.md":
        markdown = validation_page()
    if not uri.startswith("api/"):
        markdown = links_in_site(markdown, _repository_path(uri))
    return with_formulas(markdown)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Let a click on a picture open it, and tables break long names only."""
    return with_whole_names(with_pictures_to_open(html))


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Replace the address of the search's helper by its copy in the site."""
    return _local(output, page.file.dest_uri)


def on_post_template(output: str, template_name: str, config: Any) -> str:
    """Do the same in pages of the theme."""
    return _local(output, template_name)
