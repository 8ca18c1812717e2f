"""CSV files as spreadsheets and loggers write them: encodings, units, decimal commas, delimiters at line ends."""

import re

import numpy as np
import pytest

from driftjax.core import BadInput
from driftjax.logs.parse import parse_table

T = np.arange(40) / 50
ROWS = [[f"{t:.3f}", f"{10 + t:.5f}", f"{np.sin(t):.6f}"] for t in T]
NAMES = ["t", "V", "r"]
UNITS = ("s", "m/s", "rad/s")


def text_of(*lines: str, end: str = "", delimiter: str = ",") -> str:
    return "\n".join([*lines, *(delimiter.join(row) + end for row in ROWS)])


def parsed(tmp_path, text: str | bytes):
    path = tmp_path / "log.csv"
    content = text if isinstance(text, bytes) else text.encode()
    return parse_table(path, content, lambda line: False)


COMMA = text_of("t;V;r", delimiter=";").replace(".", ",")
FORMS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "units in a second comment": (text_of("# t,V,r", "# s,m/s,rad/s"), UNITS),
    "groups between names and units in comments": (
        text_of('# "t","V","r"', '# "C1","C1","C1"', '# "s","m/s","rad/s"'), UNITS),
    "words before names in comments": (text_of("# made,by,hand", "# t,V,r"), ()),
    "units without a hash below names": (text_of("# t,V,r", "s,m/s,rad/s"), UNITS),
    "a delimiter at the end of rows": (text_of("t,V,r", end=","), ()),
    "a delimiter at the end of all rows but of units": (text_of("t,V,r", "s,m/s,rad/s", end=","), UNITS),
    "a delimiter at the end below a comment": (text_of("# t,V,r", end=","), ()),
    "decimal commas": (COMMA, ()),
    "decimal commas below a comment": (f"# {COMMA}", ()),
    "decimal commas between tabs": (COMMA.replace(";", "\t"), ()),
    "decimal commas in quotes": ("t,V,r\n" + "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(";")) for line in COMMA.splitlines()[1:]), ()),
    "UTF-16": (text_of("t,V,r").encode("utf-16"), ()),
    "big-endian UTF-16": (b"\xfe\xff" + text_of("t,V,r").encode("utf-16-be"), ()),
}  # fmt: skip


@pytest.mark.parametrize("form", FORMS)
def test_what_loggers_and_spreadsheets_write_is_read(tmp_path, form):
    text, units = FORMS[form]
    table = parsed(tmp_path, text)
    assert list(table.names) == NAMES and table.units == units
    for k, name in enumerate(NAMES):
        np.testing.assert_array_equal(table.numbers(name), [float(row[k]) for row in ROWS])


TIMES = {
    "a date": ("2024-02-11 23:59:59.{:03d}", "2024-02-12 00:00:00.{:03d}"),
    "ISO 8601": ("2024-02-11T23:59:59.{:03d}Z", "2024-02-12T00:00:00.{:03d}Z"),
    "with a zone": ("2024-02-11T23:59:59.{:03d}+01:00", "2024-02-11T23:00:00.{:03d}Z"),
    "joined by lines": ("2024_02_11_23_59_59_{:03d}", "2024_02_12_00_00_00_{:03d}"),
    "of a spreadsheet": ("2024/2/11 23:59:59.{:03d}", "2024/2/12 0:00:00.{:03d}"),
    "a clock": ("23:59:59.{:03d}", "00:00:00.{:03d}"),
}


@pytest.mark.parametrize("form", TIMES)
def test_times_of_day_are_seconds(tmp_path, form):
    """Past midnight, too; names are found above them."""
    before, after = TIMES[form]
    stamps = [before.format(ms) for ms in range(500, 1000, 20)] + [after.format(ms) for ms in range(0, 500, 20)]
    table = parsed(tmp_path, "\n".join(["# made by hand", "# t,V", *(f"{stamp},1" for stamp in stamps)]))
    assert table.names == ("t", "V")
    np.testing.assert_allclose(np.diff(table.numbers("t")), 0.02, atol=1e-6)


@pytest.mark.parametrize("cell", ["1_000", "2024_02_11", "2024-13-11 10:00:00", "25 km"])
def test_what_is_neither_number_nor_time_is_refused(tmp_path, cell):
    with pytest.raises(BadInput, match=re.escape(f"row 3: column 't' holds '{cell}', not a number")):
        parsed(tmp_path, f"t,V\n1,2\n{cell},2\n").numbers("t")


@pytest.mark.parametrize("mark", ["1", "-", "", "[-]"])
def test_a_line_of_units_may_mark_a_column_without_one(tmp_path, mark):
    gain = "\n".join(",".join([*row, "2"]) for row in ROWS)
    table = parsed(tmp_path, f"t,V,r,gain\ns,m/s,rad/s,{mark}\n{gain}")
    assert table.units == (*UNITS, mark) and (table.numbers("gain") == 2).all()


def test_a_row_of_ones_with_a_word_is_a_row(tmp_path):
    table = parsed(tmp_path, "lap,t,side\n1,1,m\n1,2,m\n")
    assert not table.units and table.numbers("t").tolist() == [1, 2]


def test_latin_1_is_read(tmp_path):
    table = parsed(tmp_path, text_of("t,V,Temp °C").encode("latin-1"))
    assert table.names == ("t", "V", "Temp °C")


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("t;V\n1,000;2,000\n2,000;3,000\n", "row 2: holds '1,000', whose comma may be a decimal comma or separate"),
        ("t,V\n1,2\n3,4,\n5,6\n", "row 3: has 3 cells for 2 columns"),
        (b"t,V\n\x00\x01\x02", "is neither text in UTF-8, UTF-16 or Latin-1 nor Parquet"),
    ],
)
def test_what_may_mean_two_things_is_refused(tmp_path, text, sentence):
    with pytest.raises(BadInput, match=re.escape(sentence)):
        parsed(tmp_path, text)
