"""The tables of README.md and of the pages, out of the CSV files next to this script.

``python docs/evidence/tables.py`` writes each table of ``tables.yaml`` wherever a page has room for it::

    <!-- table: NAME -->
    <!-- end -->

``--check`` writes nothing and fails where a page and the data differ.

A table is a plain list of a file's rows (``show``: heading -> column of the file), or a grid (``rows`` and ``columns``:
label -> filter). A grid's cell is the score ``show`` of the rows of the file that pass the filters of the table
(``where``), of its row and of its column.

- Rows of one file that differ only in seed, device, commit, command and scores are seeds of one setting: their mean and
  sample deviation are shown, ``43.45 ± 0.10``. A row of a mean has several seeds in one (``0-2``) and its deviation in
  ``SCORE_sd``.
- A filter's value is one value, or a list of which one has to fit. A list of scenes is their mean; each has to be
  there.
- ``variant`` is empty unless a filter names it. Rows of other different settings in one cell are an error.
- ``data`` in a row's or column's filter takes another file, ``{data: published, method: ...}``. Filters for columns
  that this file does not have are then left out.
- ``digits`` (2) of the numbers, of the table or of a column. ``missing``: the text of cells that no row fits; an
  error unless given.
- ``best``: ``max``, ``min`` or ``none``. Of the columns of a row that show one score, the best is bold where it leads
  each other one by more than either's deviation. ``compare: rows``: of the rows of a column.
"""

from __future__ import annotations

import csv
import re
import statistics
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import yaml
from scores import SETTING_COLUMNS as OF_SCORES

from ctm_plugin.report.text import pipes, spread

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BETWEEN = re.compile(r"^(<!-- table: ([a-z0-9_]+) -->)$(.*?)^(<!-- end -->)$", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"^<!-- (table: [a-z0-9_]+|end) -->$", re.MULTILINE)
SETTINGS = (*OF_SCORES, "method")
NOT_CONVERGED = "N.C."
OF_A_COLUMN = ("data", "show", "digits")
"""Keys of a row or column that filter nothing."""
KEYS = {"data", "where", "rows", "columns", "show", "digits", "best", "compare", "missing"}

Row = Mapping[str, str]
Filter = Mapping[str, Any]
Data = Mapping[str, Sequence[Row]]


class TableError(ValueError):
    """A table that the data cannot fill."""


class Cell(NamedTuple):
    """A score: its mean and its deviation (``None``: of one seed), or text in place of both."""

    mean: float | None = None
    deviation: float | None = None
    text: str = ""

    def shown(self, digits: int) -> str:
        return self.text if self.mean is None else spread(self.mean, self.deviation, digits)


def read(folder: Path = HERE) -> dict[str, list[dict[str, str]]]:
    """The rows of every CSV file, by its name without the ending; cells that a row lacks at its end are empty."""
    data = {}
    for path in sorted(folder.glob("*.csv")):
        with path.open(encoding="utf-8", newline="") as file:
            data[path.stem] = rows = list(csv.DictReader(file, restval="", strict=True))
        for number, row in enumerate(rows, start=2):
            if None in row:
                _refuse(f"{path.name}, row {number}: found more cells than the {len(row) - 1} of the first line")
    return data


def read_tables(folder: Path = HERE) -> dict[str, dict[str, Any]]:
    """``tables.yaml``; every scalar is text."""
    return yaml.load((folder / "tables.yaml").read_text(encoding="utf-8"), yaml.BaseLoader) or {}


def markdown(name: str, table: Mapping[str, Any], data: Data) -> str:
    """A table as the pages show it.

    Raises:
        TableError: a key is unknown, a filter fits nothing, a cell has no row or several settings.
    """
    try:
        if unknown := set(table) - KEYS:
            _refuse(f"{min(unknown)}: no key of a table, expected one of {', '.join(sorted(KEYS))}")
        return pipes(_grid(table, data) if "rows" in table else _list(table, data))
    except TableError as error:
        raise TableError(f"table {name}: {error}") from None


def _list(table: Mapping[str, Any], data: Data) -> list[list[str]]:
    rows, where, show = _rows(data, table.get("data", "")), table.get("where", {}), _mapping(table, "show")
    _check(rows, where, "where")
    found = [row for row in rows if _fits(row, where)]
    if not found:
        _refuse(f"where: no row has {_told(where)}")
    for label, column in show.items():
        _known(rows, column, f"show.{label}")
    return [list(show), *([_rounded(row[column], table.get("digits")) for column in show.values()] for row in found)]


def _rounded(text: str, digits: str | None) -> str:
    return f"{float(text):.{int(digits)}f}" if digits and re.fullmatch(r"-?\d+\.\d+", text) else text


def _grid(table: Mapping[str, Any], data: Data) -> list[list[str]]:
    rows, columns = _mapping(table, "rows"), _mapping(table, "columns")
    cells = [[_cell(table, row, column, data) for column in columns.items()] for row in rows.items()]
    best, compare = table.get("best", "none"), table.get("compare", "columns")
    if best not in ("max", "min", "none") or compare not in ("columns", "rows"):
        _refuse("best: expected max, min or none; compare: columns or rows")
    groups = defaultdict(list)
    for i, line in enumerate(cells):
        for j, (cell, column) in enumerate(zip(line, columns.values(), strict=True)):
            groups[j if compare == "rows" else (i, column.get("show"))].append((i, j, cell))
    for group in groups.values() if best != "none" else ():
        if (leader := leading([cell for *_, cell in group], best)) is not None:
            i, j, cell = group[leader]
            cells[i][j] = Cell(text=f"**{cell.shown(_digits(table, list(columns.values())[j]))}**")
    lines = (
        [label, *(cell.shown(_digits(table, column)) for cell, column in zip(line, columns.values(), strict=True))]
        for label, line in zip(rows, cells, strict=True)
    )
    return [["", *columns], *lines]


def _digits(table: Mapping[str, Any], column: Filter) -> int:
    return int(column.get("digits", table.get("digits", 2)))


def leading(cells: Sequence[Cell], best: str) -> int | None:
    """Which cell leads each other one by more than the larger of both deviations, if one does; of one seed, none."""
    sign = 1 if best == "max" else -1
    numbers = [index for index, cell in enumerate(cells) if cell.mean is not None]
    if len(numbers) < 2 or any(cells[index].deviation is None for index in numbers):
        return None
    first = max(numbers, key=lambda index: sign * cells[index].mean)
    top, others = cells[first], [cells[index] for index in numbers if index != first]
    leads = (sign * (top.mean - each.mean) > max(top.deviation, each.deviation) for each in others)
    return first if all(leads) else None


def _cell(table: Mapping[str, Any], row: tuple[str, Filter], column: tuple[str, Filter], data: Data) -> Cell:
    """The score of the rows that pass three filters, those of the column before those of the row and of the table."""
    name = column[1].get("data", row[1].get("data", table.get("data", "")))
    rows, missing = _rows(data, name), table.get("missing")
    wanted = {"variant": ""} if "variant" in rows[0] else {}
    filters = {"where": table.get("where", {}), f"rows.{row[0]}": row[1], f"columns.{column[0]}": column[1]}
    for place, given in filters.items():
        lent = name != table.get("data") and "data" not in given
        own = {key: each for key, each in given.items() if key not in OF_A_COLUMN and (key in rows[0] or not lent)}
        _check(rows, own, place)
        wanted |= own
    show = column[1].get("show", row[1].get("show", ""))
    _known(rows, show, f"columns.{column[0]}.show")
    place, scenes = f"rows.{row[0]}, columns.{column[0]}", wanted.get("scene")
    if not isinstance(scenes, list):
        return _seeds(rows, wanted, show, place, missing)
    parts = [_seeds(rows, wanted | {"scene": scene}, show, place, missing) for scene in scenes]
    if texts := [part for part in parts if part.mean is None]:
        return texts[0]
    deviations = [part.deviation for part in parts]
    deviation = None if None in deviations else sum(value**2 for value in deviations) ** 0.5 / len(parts)
    return Cell(statistics.fmean(part.mean for part in parts), deviation)


def _seeds(rows: Sequence[Row], wanted: Filter, show: str, place: str, missing: str | None) -> Cell:
    """Mean and deviation of a score over the seeds of one setting."""
    found = [row for row in rows if _fits(row, wanted) and row[show]]
    if not found:
        return (
            Cell(text=missing) if missing is not None else _refuse(f"{place}: no row has {show} with {_told(wanted)}")
        )
    if differing := [key for key in SETTINGS if len({row.get(key) for row in found}) > 1]:
        values = "; ".join(f"{key}: {', '.join(sorted({row[key] for row in found}))}" for key in differing)
        _refuse(f"{place}: rows of several settings fit, name one of {values}")
    seeds = [row.get("seed") for row in found]
    if len(found) > 1 and (len(set(seeds)) < len(found) or any("-" in str(seed) for seed in seeds)):
        _refuse(f"{place}: several rows have seed {', '.join(map(str, dict.fromkeys(seeds)))} with {_told(wanted)}")
    if any(row[show] == NOT_CONVERGED for row in found):
        return Cell(text=NOT_CONVERGED)
    try:
        values, deviation = [float(row[show]) for row in found], found[0].get(f"{show}_sd")
        if len(values) > 1:
            return Cell(statistics.fmean(values), statistics.stdev(values))
        return Cell(values[0], float(deviation) if deviation else None)
    except ValueError as error:
        return _refuse(f"{place}.{show}: {error}, expected a number or {NOT_CONVERGED}")


def _rows(data: Data, name: str) -> Sequence[Row]:
    if not data.get(name):
        _refuse(f"data: found {name or 'nothing'}, expected one of {', '.join(each for each in data if data[each])}")
    return data[name]


def _mapping(table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    if not isinstance(table.get(key), dict) or not table[key]:
        _refuse(f"{key}: expected labels, each with what it stands for")
    return table[key]


def _known(rows: Sequence[Row], column: str, place: str) -> None:
    if column not in rows[0]:
        _refuse(f"{place}: found {column or 'nothing'}, expected one of {', '.join(rows[0])}")


def _check(rows: Sequence[Row], wanted: Filter, place: str) -> None:
    """Refuse columns and values that the file does not have."""
    for key, value in wanted.items():
        _known(rows, key, f"{place}.{key}")
        for one in value if isinstance(value, list) else [value]:
            if not any(row[key] == one for row in rows):
                _refuse(f"{place}.{key}: no row has {one!r}")


def _fits(row: Row, wanted: Filter) -> bool:
    return all(row[key] in value if isinstance(value, list) else row[key] == value for key, value in wanted.items())


def _told(wanted: Filter) -> str:
    return ", ".join(f"{key}={value}" for key, value in wanted.items())


def _refuse(why: str) -> NoReturn:
    raise TableError(why)


def filled(text: str, tables: Mapping[str, Any], data: Data) -> str:
    """A page with its tables written anew.

    Raises:
        TableError: a table is unknown or cannot be made, or a marker has no partner.
    """

    def fill(found: re.Match[str]) -> str:
        if found[2] not in tables:
            _refuse(f"table {found[2]}: not in tables.yaml")
        return f"{found[1]}\n\n{markdown(found[2], tables[found[2]], data)}\n\n{found[4]}"

    marks = [mark[1] for mark in MARK.finditer(text)]
    if any((mark == "end") == (index % 2 == 0) for index, mark in enumerate(marks)) or len(marks) % 2:
        _refuse("expected one <!-- end --> after each <!-- table: NAME -->")
    return BETWEEN.sub(fill, text)


def main(arguments: Sequence[str]) -> int:
    """Write the tables of README.md and of the pages, or with ``--check`` say which pages would change."""
    tables, data = read_tables(), read()
    faults = 0
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        text, name = page.read_text(encoding="utf-8"), page.relative_to(ROOT)
        try:
            new = filled(text, tables, data)
        except TableError as error:
            print(f"{name}: {error}", file=sys.stderr)
            faults += 1
            continue
        if new == text:
            continue
        if "--check" in arguments:
            print(f"{name}: tables and data differ: make tables", file=sys.stderr)
            faults += 1
        else:
            page.write_text(new, encoding="utf-8")
            print(f"written: {name}")
    return int(faults > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
