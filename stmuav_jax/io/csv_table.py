"""Tables of numbers with a line of names, as programs and spreadsheets of many countries write them."""

import contextlib
import csv
import io
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, format_value, quote_name
from .netcdf import FileError, regular_file, write_atomically

_SEPARATORS = (",", ";", "\t")
# Characters that no text has.
_NO_TEXT = re.compile("[\0-\6]")


class CsvTable(NamedTuple):
    """Rows of text below a line of names; a name may end with its unit, as in "a [m]" or "a (m)".

    Attributes:
        source: path of the file. heads: entries of the first line. rows: cells of each further line.
        lines: number of each row's line. decimal: sign of decimals.
        is_cut: true if the last row was not whole; it is not among the rows.
    """

    source: Path
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    lines: Sequence[int]
    decimal: str
    is_cut: bool

    def find_column(self, name: str, *, with_unit: bool = True) -> int:
        """Index of a column.

        Args:
            with_unit: the name is the whole entry of the header; else it may leave out the unit.

        Raises:
            SettingError: no column has the name, or more than one.
        """
        places = [k for k, head in enumerate(self.heads) if head == name]
        if not places and not with_unit:
            places = [k for k, head in enumerate(self.heads) if split_unit(head)[0] == name]
        if not places:
            hint = nearest_names(name[:SHOWN], [head[:SHOWN] for head in self.heads if head])
            raise SettingError(f"{self.source} has no column {quote_name(name)}.{hint}")
        if len(places) > 1:
            raise SettingError(f"{self.source} has {len(places)} columns {quote_name(name)}.")
        return places[0]

    def read_column(
        self, place: int, *, admits_blanks: bool = True, admits_infinite: bool = True
    ) -> Float[np.ndarray, " k"]:
        """Numbers of the column at an index; a blank cell is NaN.

        Args:
            admits_blanks: blank cells, and the word nan, are valid. admits_infinite: so are infinite numbers.

        Raises:
            FileError: there is no row, rows have other lengths than the header, or a cell is not a valid number.
        """
        if not self.rows:
            raise FileError(f"{self.source} has no rows below its header.")
        numbers = np.full(len(self.rows), np.inf)
        for k, row in enumerate(self.rows):
            # A separator too many shifts cells to other columns, where they may still be numbers.
            if len(row) != len(self.heads):
                raise FileError(
                    f"{self.source}, line {self.lines[k]}: {len(row)} cells, but the header has {len(self.heads)}; "
                    "equal numbers would be valid."
                )
            cell = row[place].strip()
            is_valid = False
            with contextlib.suppress(ValueError):
                x = numbers[k] = float(cell.replace(self.decimal, ".") or "nan")
                is_valid = not (np.isinf(x) and not admits_infinite)
                is_valid &= not (np.isnan(x) and not admits_blanks)
            if not is_valid:
                kind = "a number" if admits_infinite else "a finite number"
                raise FileError(
                    f"{self.source}, line {self.lines[k]}: {format_value(cell)} in column "
                    f"{quote_name(self.heads[place])} is not {kind}."
                )
        return numbers

    def read_numbers(self, name: str, *, admits_blanks: bool = False) -> Float[np.ndarray, " k"]:
        """Finite numbers of the column of a name, see `find_column` and `read_column`."""
        place = self.find_column(name)
        return self.read_column(place, admits_blanks=admits_blanks, admits_infinite=False)


def split_unit(head: str) -> tuple[str, str]:
    """Name and unit of a column's head."""
    match = re.fullmatch(r"(.*?)\s*[\[(]([^\])]*)[\])]", head)
    return (match[1], match[2].strip()) if match else (head, "")


def read_csv_table(
    path: str | os.PathLike[str],
    *,
    separator: str | None = None,
    decimal: str | None = None,
    admits_cut: bool = False,
) -> CsvTable:
    """Read a table from a CSV file in UTF-8, UTF-16 or Windows' code.

    Args:
        separator: of cells; by default the most frequent of comma, semicolon and tab in the first line.
        decimal: sign of decimals; by default a comma is one unless it separates.
        admits_cut: a last row that is not whole, or has no end of line, is left out, not refused.

    Raises:
        FileError: the file is missing or is not text.
    """
    source = regular_file(path)
    try:
        text = _decode_text(source.read_bytes())
    except OSError as error:
        raise FileError(f"{source} cannot be read: {error.strerror}.") from None
    # Binary files decode in Windows' code too; control characters tell that they are no text.
    if odd := _NO_TEXT.search(text):
        raise FileError(
            f"character {odd.start() + 1} of {source} is {odd[0]!a}, which no text has."
        )
    first = next((line for line in text.splitlines() if line.strip()), "")
    # The first line has names, in which a comma is no decimal sign.
    sign = separator or max(_SEPARATORS, key=first.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=sign)
    try:
        # blank lines are none, as in a file that ends with several
        entries = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise FileError(f"{source} is not a readable CSV file: {error}.") from None
    heads = [cell.strip() for cell in entries[0][1]] if entries else []
    # without an end of its line the last number may have lost digits
    is_cut = admits_cut and len(entries) > 1
    is_cut &= bool(entries) and (len(entries[-1][1]) < len(heads) or text[-1] not in "\n\r")
    entries = entries[1 : len(entries) - is_cut]
    lines, rows = [line for line, _ in entries], [row for _, row in entries]
    # with another separator the comma is taken for the decimal sign
    return CsvTable(source, heads, rows, lines, decimal or ("." if sign == "," else ","), is_cut)


def _decode_text(data: bytes) -> str:
    """Text of a file in UTF-8 or UTF-16, with or without a mark, or in Windows' code, which has all bytes but five."""
    # UTF-8 comes before Windows' code, which takes nearly all bytes and would misread it.
    codes = ("utf-16",) if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ("utf-8-sig", "cp1252")
    for code in codes:
        with contextlib.suppress(UnicodeDecodeError):
            return data.decode(code)
    return data.decode("latin-1")


def write_csv_table(
    path: str | os.PathLike[str], heads: Sequence[str], columns: Sequence[np.ndarray], form: str
) -> Path:
    """Write numbers as a CSV file below a line of names, atomically; return the path.

    Args:
        heads: names of the columns. columns: numbers (k,) each, or (k, n) for n of the names.
        form: format of a number, such as "%.9g".
    """
    text = io.StringIO()
    table = np.column_stack(columns)
    np.savetxt(text, table, form, ",", header=",".join(heads), comments="")
    return write_atomically(path, text.getvalue().encode())
