"""Tables of numbers of other countries and programs are read as they are meant, or refused by line and column."""

import numpy as np
import pytest

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.io import FileError
from stmuav_jax.io.csv_table import read_csv_table


@pytest.mark.parametrize(
    ("code", "separator", "decimal"),
    [("utf-8", ",", "."), ("utf-8-sig", ";", ","), ("utf-16", "\t", ","), ("cp1252", ";", ",")],
)
def test_separators_decimals_and_codes(code, separator, decimal, tmp_path):
    lines = [["t", "Höhe [m]"], ["0", "1.5"], ["0.1", ""], [], ["0.2", "-2e3"]]
    text = "\r\n".join(separator.join(line).replace(".", decimal) for line in lines)
    (tmp_path / "table.csv").write_bytes(text.encode(code))
    table = read_csv_table(tmp_path / "table.csv")
    np.testing.assert_array_equal(table.read_column(0), [0.0, 0.1, 0.2])
    place = table.find_column("Höhe", with_unit=False)
    np.testing.assert_array_equal(table.read_column(place), [1.5, np.nan, -2000.0])
    with pytest.raises(SettingError, match=r"no column 'Höhe'. Did you mean 'Höhe \[m\]'"):
        table.find_column("Höhe")
    with pytest.raises(FileError, match=r"line 3: '' in column 'Höhe \[m\]' is not a finite"):
        table.read_column(place, admits_blanks=False, admits_infinite=False)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,a\n", "no rows below its header"),
        ("t,a\n0,1\n\n1,2,3\n", "line 4: 3 cells, but the header has 2"),
        ("t,a\n0,1\n1,1.2.3\n", "line 3: '1.2.3' in column 'a' is not a number"),
    ],
)
def test_tables_that_are_not_whole_are_refused(text, words, tmp_path):
    (tmp_path / "table.csv").write_text(text)
    with pytest.raises(FileError, match=words):
        read_csv_table(tmp_path / "table.csv").read_column(1)
