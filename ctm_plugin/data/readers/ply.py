"""Points of a PLY file: positions of its vertices, out of text or little-endian binary, read with only numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from ctm_plugin.data.readers.folders import as_data_error, read_bytes
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE

PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
"""numpy's types by PLY's names of numbers, old and new."""
PLY_EXPECTED = (
    "a PLY file, ascii or binary_little_endian, whose first element is vertex, with properties x, y, z, each a number"
)


def read_ply(path: Path) -> Float64[np.ndarray, "p 3"]:
    """Read the positions ``[P, 3]`` of the vertices, none that are NaN or beyond ``MAX_COORDINATE``.

    Raises a DataError for what is not ``PLY_EXPECTED``.
    """
    head, _, body = read_bytes(path, PLY_EXPECTED).partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    elements = [number for number, line in enumerate(lines) if line[:1] == ["element"]]
    first, last = elements[0] if elements else 0, elements[1] if len(elements) > 1 else len(lines)
    encoding = next((line[1] for line in lines if line[:1] == ["format"] and len(line) > 1), None)
    if not lines or lines[0] != ["ply"] or encoding not in ("ascii", "binary_little_endian"):
        raise DataError(path, f"another header, of format {encoding}", PLY_EXPECTED)
    with as_data_error(path, "vertices that cannot be read", PLY_EXPECTED):
        properties = [line[1:] for line in lines[first:last] if line[:1] == ["property"]]
        kinds = np.dtype([(name, f"<{PLY_TYPES[kind]}") for kind, name in properties])
        _, name, count = lines[first]
        if name != "vertex" or int(count) < 0:
            raise ValueError(f"{count} of {name}")
        body = body.partition(b"\n")[2]
        if encoding == "ascii":
            rows = np.array([row.split() for row in body.split(b"\n")[: int(count)]], np.float64)
            positions = rows.reshape(int(count), len(kinds))[:, [kinds.names.index(axis) for axis in "xyz"]]
        else:
            table = np.frombuffer(body, kinds, int(count))
            positions = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return positions[(np.abs(positions) <= MAX_COORDINATE).all(1)]  # false for NaN
