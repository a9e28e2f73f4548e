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
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BETWEEN = re.compile(r"^(<!-- table: ([a-z0-9_]+) -->)$(.*?)^(<!-- end -->)$", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"^<!-- (table: [a-z0-9_]+|end) -->$", re.MULTILINE)
OF_A_RUN = ("seed", "device", "commit", "command")
"""Columns in which the runs of one setting may differ, besides scores."""
SETTINGS = ("scene", "light", "backbone", "colours", "variant", "geometry", "background", "budget", "size", "method")
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
        if self.mean is None:
            return self.text
        spread = "" if self.deviation is None else f" ± {self.deviation:.{digits}f}"
        return f"{self.mean:.{digits}f}{spread}"


def read(folder: Path = HERE) -> dict[str, list[dict[str, str]]]:
    """The rows of every CSV file, by its name without the ending; cells that a row lacks at its end are empty."""
    data = {}
    for path in sorted(folder.glob("*.csv")):
        with path.open(encoding="utf-8", newline="") as file:
            data[path.stem] = list(csv.DictReader(file, restval="", strict=True))
        for number, row in enumerate(data[path.stem], start=2):
            if None in row:
                raise TableError(
                    f"{path.name}, row {number}: found more cells than the {len(row) - 1} of the first line"
                )
    return data


def read_tables(folder: Path = HERE) -> dict[str, dict[str, Any]]:
    """``tables.yaml``; every scalar is text."""
    return yaml.load((folder / "tables.yaml").read_text(encoding="utf-8"), yaml.BaseLoader) or {}


def pages() -> list[Path]:
    """README.md and the pages of ``docs/`` that are written by hand."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def markdown(name: str, table: Mapping[str, Any], data: Data) -> str:
    """A table as the pages show it.

    Raises:
        TableError: a key is unknown, a filter fits nothing, a cell has no row or several settings.
    """
    try:
        if unknown := set(table) - KEYS:
            raise TableError(f"{min(unknown)}: no key of a table, expected one of {', '.join(sorted(KEYS))}")
        lines = _grid(table, data) if "rows" in table else _list(table, data)
    except TableError as error:
        raise TableError(f"table {name}: {error}") from None
    head, *body = [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines]
    return "\n".join([head, "|" + "---|" * len(lines[0]), *body])


def _list(table: Mapping[str, Any], data: Data) -> list[list[str]]:
    rows = _rows(data, table.get("data", ""))
    found = _fitting(rows, table.get("where", {}), "where")
    show = _mapping(table, "show")
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
        raise TableError("best: expected max, min or none; compare: columns or rows")
    shows = [column.get("show", "") for column in columns.values()]
    bold = set()
    if best != "none":
        groups = _groups(len(rows), shows) if compare == "columns" else _groups_of_rows(len(rows), len(columns))
        for group in groups:
            leader = leading([cells[i][j] for i, j in group], best)
            bold |= set() if leader is None else {group[leader]}
    digits = [int(column.get("digits", table.get("digits", 2))) for column in columns.values()]
    return [
        ["", *columns],
        *(
            [label, *(f"**{cell.shown(n)}**" if (i, j) in bold else cell.shown(n) for j, (cell, n) in enumerate(line))]
            for i, (label, line) in enumerate(
                zip(rows, (zip(line, digits, strict=True) for line in cells), strict=True)
            )
        ),
    ]


def _groups(rows: int, shows: Sequence[str]) -> Iterator[list[tuple[int, int]]]:
    """Places of cells to compare: of each row, the columns with the same score."""
    for i in range(rows):
        for show in dict.fromkeys(shows):
            yield [(i, j) for j, other in enumerate(shows) if other == show]


def _groups_of_rows(rows: int, columns: int) -> Iterator[list[tuple[int, int]]]:
    for j in range(columns):
        yield [(i, j) for i in range(rows)]


def leading(cells: Sequence[Cell], best: str) -> int | None:
    """Which cell leads each other one by more than the larger of both deviations, if one does; of one seed, none."""
    sign = 1 if best == "max" else -1
    numbers = {index: cell for index, cell in enumerate(cells) if cell.mean is not None}
    if len(numbers) < 2 or any(cell.deviation is None for cell in numbers.values()):
        return None
    first = max(numbers, key=lambda index: sign * numbers[index].mean)
    others = [cell for index, cell in numbers.items() if index != first]
    top = numbers[first]
    leads = (sign * (top.mean - cell.mean) > max(top.deviation, cell.deviation) for cell in others)
    return first if all(leads) else None


def _cell(table: Mapping[str, Any], row: tuple[str, Filter], column: tuple[str, Filter], data: Data) -> Cell:
    """The score of the rows that pass three filters, those of the column before those of the row and of the table."""
    name = column[1].get("data", row[1].get("data", table.get("data", "")))
    rows = _rows(data, name)
    wanted = {"variant": ""} if "variant" in rows[0] else {}
    places = {}
    for label, filters in (
        ("where", table.get("where", {})),
        (f"rows.{row[0]}", row[1]),
        (f"columns.{column[0]}", column[1]),
    ):
        lent = name != table.get("data") and "data" not in filters
        for key, value in filters.items():
            if key not in OF_A_COLUMN and (key in rows[0] or not lent):
                wanted[key], places[key] = value, f"{label}.{key}"
    _check(rows, {places[key]: (key, wanted[key]) for key in places})
    show = column[1].get("show", row[1].get("show", ""))
    _known(rows, show, f"columns.{column[0]}.show")
    place = f"rows.{row[0]}, columns.{column[0]}"
    scenes = wanted.get("scene")
    if not isinstance(scenes, list):
        return _seeds(rows, wanted, show, place, table.get("missing"))
    parts = [_seeds(rows, wanted | {"scene": scene}, show, place, table.get("missing")) for scene in scenes]
    if texts := [part for part in parts if part.mean is None]:
        return texts[0]
    deviations = [part.deviation for part in parts]
    spread = None if None in deviations else sum(value**2 for value in deviations) ** 0.5 / len(parts)
    return Cell(statistics.fmean(part.mean for part in parts), spread)


def _seeds(rows: Sequence[Row], wanted: Filter, show: str, place: str, missing: str | None) -> Cell:
    """Mean and deviation of a score over the seeds of one setting."""
    found = [row for row in rows if _fits(row, wanted) and row[show]]
    if not found:
        if missing is not None:
            return Cell(text=missing)
        raise TableError(f"{place}: no row has {show} with {_told(wanted)}")
    if differing := [key for key in SETTINGS if len({row.get(key) for row in found}) > 1]:
        values = "; ".join(f"{key}: {', '.join(sorted({row[key] for row in found}))}" for key in differing)
        raise TableError(f"{place}: rows of several settings fit, name one of {values}")
    by_seed = defaultdict(list)
    for row in found:
        by_seed[row.get("seed")].append(row)
    if len(found) > 1 and (len(by_seed) < len(found) or any("-" in str(seed) for seed in by_seed)):
        raise TableError(f"{place}: several rows have seed {', '.join(map(str, by_seed))} with {_told(wanted)}")
    if any(row[show] == NOT_CONVERGED for row in found):
        return Cell(text=NOT_CONVERGED)
    values = [_number(row[show], f"{place}.{show}") for row in found]
    if len(values) > 1:
        return Cell(statistics.fmean(values), statistics.stdev(values))
    spread = found[0].get(f"{show}_sd")
    return Cell(values[0], _number(spread, f"{place}.{show}_sd") if spread else None)


def _rows(data: Data, name: str) -> Sequence[Row]:
    if name not in data:
        raise TableError(f"data: found {name or 'nothing'}, expected one of {', '.join(data)}")
    if not data[name]:
        raise TableError(f"data: {name}.csv has no rows")
    return data[name]


def _mapping(table: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    if not isinstance(table.get(key), dict) or not table[key]:
        raise TableError(f"{key}: expected labels, each with what it stands for")
    return table[key]


def _known(rows: Sequence[Row], column: str, place: str) -> None:
    if column not in rows[0]:
        raise TableError(f"{place}: found {column or 'nothing'}, expected one of {', '.join(rows[0])}")


def _fitting(rows: Sequence[Row], wanted: Filter, place: str) -> list[Row]:
    """The rows that pass a filter; each of its values has to fit one."""
    _check(rows, {f"{place}.{key}": each for key, each in zip(wanted, wanted.items(), strict=True)})
    found = [row for row in rows if _fits(row, wanted)]
    if not found:
        raise TableError(f"{place}: no row has {_told(wanted)}")
    return found


def _check(rows: Sequence[Row], wanted: Mapping[str, tuple[str, Any]]) -> None:
    """Refuse columns and values that the file does not have; ``wanted``: place in ``tables.yaml`` -> column, value."""
    for place, (key, value) in wanted.items():
        _known(rows, key, place)
        for one in value if isinstance(value, list) else [value]:
            if not any(row[key] == one for row in rows):
                raise TableError(f"{place}: no row has {one!r}")


def _fits(row: Row, wanted: Filter) -> bool:
    return all(row[key] in value if isinstance(value, list) else row[key] == value for key, value in wanted.items())


def _told(wanted: Filter) -> str:
    return ", ".join(f"{key}={value}" for key, value in wanted.items())


def _number(text: str, place: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise TableError(f"{place}: found {text!r}, expected a number or {NOT_CONVERGED}") from None


def filled(text: str, tables: Mapping[str, Any], data: Data) -> str:
    """A page with its tables written anew.

    Raises:
        TableError: a table is unknown or cannot be made, or a marker has no partner.
    """

    def fill(found: re.Match[str]) -> str:
        if found[2] not in tables:
            raise TableError(f"table {found[2]}: not in tables.yaml")
        return f"{found[1]}\n\n{markdown(found[2], tables[found[2]], data)}\n\n{found[4]}"

    marks = [mark[1] for mark in MARK.finditer(text)]
    if any((mark == "end") == (index % 2 == 0) for index, mark in enumerate(marks)) or len(marks) % 2:
        raise TableError("expected one <!-- end --> after each <!-- table: NAME -->")
    return BETWEEN.sub(fill, text)


def main(arguments: Sequence[str]) -> int:
    """Write the tables of all pages, or with ``--check`` say which pages would change."""
    tables, data = read_tables(), read()
    faults = 0
    for page in pages():
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
