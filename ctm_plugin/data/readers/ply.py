"""Points of a PLY file: positions of its vertices, out of text or little-endian binary, read with only numpy."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.folders import read_bytes, told
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
"""PLY's names of numbers, old and new, by numpy's."""
END = b"end_header"


def read_ply(path: Path) -> Float64[np.ndarray, "p 3"]:
    """Read the positions ``[P, 3]`` of the vertices, none that are NaN or absurdly far away.

    Raises:
        DataError: the file is damaged, or of a kind that is not read here.
    """
    data = read_bytes(path, "a PLY file")
    head, found, body = data.partition(END)
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    if not found or not lines or lines[0] != ["ply"]:
        raise DataError(path, "no header that starts with ply and ends with end_header", "a PLY file")
    encoding = next((line[1] for line in lines if line[0:1] == ["format"] and len(line) > 1), "none")
    if encoding not in ("ascii", "binary_little_endian"):
        raise DataError(path, f"format {encoding}", "ascii or binary_little_endian")
    count, kinds = vertices(path, lines)
    body = body.partition(b"\n")[2]
    if encoding == "ascii":
        rows = text_rows(path, body, count, len(kinds))
        positions = rows[:, [kinds.names.index(axis) for axis in "xyz"]]
    else:
        if count * kinds.itemsize > len(body):
            raise DataError(path, f"{len(body)} bytes after the header", f"{count} vertices of {kinds.itemsize} bytes")
        table = np.frombuffer(body, kinds, count)
        positions = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return positions[(np.abs(positions) <= MAX_COORDINATE).all(1)]  # false for NaN


def vertices(path: Path, lines: list[list[str]]) -> tuple[int, np.dtype]:
    """Read how many vertices there are, and of what numbers each is made; they come before all other elements.

    Raises:
        DataError: the header does not say so.
    """
    expected = "element vertex first, with properties x, y, z, each a number"
    elements = [number for number, line in enumerate(lines) if line[0:1] == ["element"]]
    if not elements or lines[elements[0]][1:2] != ["vertex"]:
        raise DataError(path, "another header", expected)
    last = elements[1] if len(elements) > 1 else len(lines)
    properties = [line[1:] for line in lines[elements[0] : last] if line[0:1] == ["property"]]
    with told(path, "a header that cannot be read", expected):
        kinds = np.dtype([(name, f"<{TYPES[kind]}") for kind, name in properties])
        count = int(lines[elements[0]][2])
    if count < 0 or not set("xyz") <= set(kinds.names or ()):
        raise DataError(path, f"{count} vertices with {', '.join(kinds.names or ('nothing',))}", expected)
    return count, kinds


def text_rows(path: Path, body: bytes, count: int, columns: int) -> Float64[np.ndarray, "p c"]:
    """Read the first ``count`` lines of numbers.

    Raises:
        DataError: there are fewer, or they are none.
    """
    expected = f"{count} lines of {columns} numbers after the header"
    lines = body.split(b"\n")
    if len(lines) < count:
        raise DataError(path, f"{len(lines)} lines", expected)
    with told(path, "lines that cannot be read", expected):
        rows = np.loadtxt(io.BytesIO(b"\n".join(lines[:count])), ndmin=2) if count else np.empty((0, columns))
    if rows.shape != (count, columns):
        raise DataError(path, f"{rows.shape[0]} lines of {rows.shape[1]} numbers", expected)
    return rows
