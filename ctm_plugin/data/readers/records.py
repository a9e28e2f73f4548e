"""JSON objects whose values are checked as they are read."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.folders import read_bytes, told
from ctm_plugin.errors import DataError
from ctm_plugin.settings.setting import Number, is_number


class Record:
    """A JSON object that knows where it stands, so that a message can name the place of a fault.

    Args:
        values: the object.
        source: the file it comes from.
        where: its place in that file, such as ``frames[3]``; empty for the outermost.
    """

    def __init__(self, values: dict[str, Any], source: Path, where: str = ""):
        self.values = values
        self.source = source
        self.where = where

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def place(self, key: str) -> str:
        """The value's place in the file, for messages."""
        return f"{self.where}.{key}" if self.where else key

    def fault(self, key: str, expected: str) -> DataError:
        """The error that tells what stands under ``key`` and what should."""
        if key not in self.values:
            return DataError(self.source, f"no {self.place(key)!r}", expected)
        return DataError(self.source, f"{self.place(key)} = {reprlib.repr(self.values[key])}", expected)

    def number(self, key: str, allowed: Callable[[Number], bool], expected: str) -> float:
        """A number for which ``allowed`` holds, a bounded interval written as comparisons (NaN then fails them).

        Raises:
            DataError: missing, not a number, or not allowed.
        """
        value = self.values.get(key)
        if not is_number(value) or not allowed(value):
            raise self.fault(key, expected)
        return float(value)

    def text(self, key: str, expected: str) -> str:
        """A string that is not empty.

        Raises:
            DataError: missing, empty or not a string.
        """
        value = self.values.get(key)
        if not isinstance(value, str) or not value:
            raise self.fault(key, expected)
        return value

    def texts(self, key: str, expected: str) -> list[str]:
        """A list of strings.

        Raises:
            DataError: missing or not such a list.
        """
        values = self.values.get(key)
        if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
            raise self.fault(key, expected)
        return values

    def records(self, key: str, expected: str) -> list[Record]:
        """A list of at least one object.

        Raises:
            DataError: missing, empty or not a list of objects.
        """
        values = self.values.get(key)
        if not isinstance(values, list) or not values:
            raise self.fault(key, expected)
        for index, value in enumerate(values):
            if not isinstance(value, dict):
                raise DataError(self.source, f"{self.place(key)}[{index}] = {reprlib.repr(value)}", "a JSON object")
        return [Record(value, self.source, f"{self.place(key)}[{index}]") for index, value in enumerate(values)]

    def matrix(self, key: str, rows: int, columns: int, limit: float) -> Float64[np.ndarray, "rows columns"]:
        """``rows`` lists of ``columns`` numbers, each below ``limit`` in size.

        Raises:
            DataError: missing, of another shape, not numbers, NaN, infinite or too large.
        """
        expected = f"{rows} rows of {columns} finite numbers below {limit:g}"
        value = self.values.get(key)
        shaped = isinstance(value, list) and len(value) == rows
        if not shaped or not all(isinstance(row, list) and len(row) == columns for row in value):
            raise self.fault(key, expected)
        for row in value:
            for entry in row:
                if not is_number(entry) or not -limit < entry < limit:
                    raise DataError(self.source, f"{reprlib.repr(entry)} in {self.place(key)}", expected)
        return np.array(value, dtype=np.float64)


def read_json(path: Path) -> Any:
    """What a JSON file holds.

    Raises:
        DataError: the file is missing, unreadable or not JSON.
    """
    data = read_bytes(path, "a JSON file")
    with told(path, "something that is not JSON", "a JSON file"):
        return json.loads(data)


def read_record(path: Path) -> Record:
    """The JSON object in a file.

    Raises:
        DataError: the file is missing, unreadable, not JSON, or holds something else than an object.
    """
    values = read_json(path)
    if not isinstance(values, dict):
        raise DataError(path, f"a JSON {type(values).__name__}", "a JSON object")
    return Record(values, path)
