"""Tables and lines of the terminal, printed literally: brackets are units and paths, not markup."""

from rich.console import Console
from rich.table import Table
from rich.text import Text


def line(out: Console, words: object) -> None:
    """Print words literally: brackets are units and paths, not markup."""
    out.print(Text(str(words)), highlight=False)


def table(*heads: str, title: str | None = None, right: int = 0) -> Table:
    """Table whose title and heads are printed literally; rows are added by `row`.

    Args:
        heads: heads of the columns.
        title: title of the table.
        right: index of the first right-aligned column, 0 for none.
    """
    made = Table(title=None if title is None else Text(title), title_justify="left")
    for k, head in enumerate(heads):
        made.add_column(Text(head), justify="right" if right and k >= right else "left")
    return made


def row(made: Table, *cells: object) -> None:
    """Add a row of cells that are printed literally."""
    made.add_row(*(Text(str(cell)) for cell in cells))
