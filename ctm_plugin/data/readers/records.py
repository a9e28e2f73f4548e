"""JSON objects whose values are checked as they are read: a message names the file and the place in it."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.folders import as_data_error, inside, read_bytes, state_of
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE
from ctm_plugin.settings.setting import Number, is_number


class Record:
    """A JSON object with its file and its place there, for checks whose errors name both.

    Args:
        values: the object.
        source: the file it comes from.
        where: its place in that file, such as ``frames[3]``; empty for the outermost.
    """

    def __init__(self, values: dict[str, Any], source: Path, where: str = ""):
        self.values, self.source, self.where = values, source, where

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def place(self, key: str) -> str:
        """Place of a key's value in the file, for messages."""
        return f"{self.where}.{key}" if self.where else key

    def fault(self, key: str, expected: str) -> DataError:
        """Make the error that says what stands under ``key`` and what was expected."""
        if key not in self.values:
            return DataError(self.source, f"no {self.place(key)!r}", expected)
        return DataError(self.source, f"{self.place(key)} = {reprlib.repr(self.values[key])}", expected)

    def checked(self, key: str, allowed: Callable[[Any], bool], expected: str) -> Any:
        """Read the value under ``key``; ``None`` where there is none; DataError where ``allowed`` does not hold."""
        value = self.values.get(key)
        if not allowed(value):
            raise self.fault(key, expected)
        return value

    def number(self, key: str, allowed: Callable[[Number], bool], expected: str) -> float:
        """Read a number for which ``allowed`` holds, a bounded interval written as comparisons (NaN then fails)."""
        return float(self.checked(key, lambda value: is_number(value) and allowed(value), expected))

    def text(self, key: str, expected: str) -> str:
        """Read a string that is not empty."""
        return self.checked(key, lambda value: isinstance(value, str) and value != "", expected)

    def texts(self, key: str, expected: str) -> list[str]:
        """Read a list of strings."""
        return self.checked(
            key, lambda values: isinstance(values, list) and all(isinstance(each, str) for each in values), expected
        )

    def records(self, key: str, expected: str) -> list[Record]:
        """Read a list of at least one JSON object, else raise a DataError."""
        values = self.checked(key, lambda value: isinstance(value, list) and len(value) > 0, expected)
        places = [f"{self.place(key)}[{index}]" for index in range(len(values))]
        for place, value in zip(places, values, strict=True):
            if not isinstance(value, dict):
                raise DataError(self.source, f"{place} = {reprlib.repr(value)}", "a JSON object")
        return [Record(value, self.source, place) for place, value in zip(places, values, strict=True)]

    def matrix(self, key: str, rows: int, columns: int, limit: float) -> Float64[np.ndarray, "rows columns"]:
        """Read a matrix, ``rows`` lists of ``columns`` numbers, each below ``limit`` in size, else a DataError."""
        expected = f"{rows} rows of {columns} finite numbers below {limit:g}"

        def shaped(value: Any) -> bool:
            sized = isinstance(value, list) and len(value) == rows
            return sized and all(isinstance(row, list) and len(row) == columns for row in value)

        value = self.checked(key, shaped, expected)
        for entry in (entry for row in value for entry in row):
            if not is_number(entry) or not -limit < entry < limit:
                raise DataError(self.source, f"{reprlib.repr(entry)} in {self.place(key)}", expected)
        return np.array(value, dtype=np.float64)


def parse_record(content: bytes, source: Path) -> Record:
    """Parse a file's JSON object, or the only object of a list, as exiftool writes it; else a DataError."""
    with as_data_error(source, "something that is not JSON", "a JSON file"):
        values = json.loads(content)
    values = values[0] if isinstance(values, list) and len(values) == 1 else values
    if not isinstance(values, dict):
        raise DataError(source, f"a JSON {type(values).__name__}", "a JSON object")
    return Record(values, source)


def read_record(path: Path) -> Record:
    """Read the JSON object in a file, cached until the file changes: callers must not change it."""
    return _parsed(path, state_of(path))


@lru_cache(maxsize=4)
def _parsed(path: Path, _state: tuple[int, int] | None) -> Record:
    return parse_record(read_bytes(path, "a JSON file"), path)


def rendered(root: Path, key: str) -> float:
    """Number that this project's renderer wrote into a data set's ``settings.json``; 1 for other data sets.

    The key ``light`` is the scene's light relative to normal; ``depth_scale`` is scene units in one step of its depth
    pictures.
    """
    path = inside(root, "settings.json")
    record = read_record(path) if path.exists() else {}
    return record.number(key, lambda v: 0 < v <= MAX_COORDINATE, "a number > 0") if key in record else 1.0
