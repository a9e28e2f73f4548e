"""COLMAP's text model, turned into the bytes of its binary one, so that both are read and checked in one place."""

from __future__ import annotations

import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path

from ctm_plugin.data.readers.folders import read_bytes
from ctm_plugin.errors import DataError

MODELS = {
    "SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4, "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6, "FOV": 7, "SIMPLE_RADIAL_FISHEYE": 8, "RADIAL_FISHEYE": 9, "THIN_PRISM_FISHEYE": 10,
    "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "DIVISION": 13, "SIMPLE_FISHEYE": 14, "FISHEYE": 15,
    "EUCM": 16, "EQUIRECTANGULAR": 17,
}  # fmt: skip
"""COLMAP's numbers of its camera models."""
PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 6: 12}
"""How many each of those has that are read here."""


NOT_A_NUMBER = re.compile(r"[+-]?(nan|inf|1\.#)", re.IGNORECASE)
"""How Windows' programs write NaN and infinity begins: ``-nan(ind)``, ``1.#QNAN``."""


def decimal(text: str) -> float:
    """Read a number; NaN of what is none in another way than Python's."""
    return math.nan if NOT_A_NUMBER.match(text) else float(text)


def camera(line: str, _: str) -> bytes:
    """``ID MODEL WIDTH HEIGHT PARAMETERS``."""
    number, model, width, height, *values = line.split()
    kind = MODELS[model]
    if len(values) != PARAMETERS.get(kind, len(values)):
        raise ValueError(f"{len(values)} parameters, {model} has {PARAMETERS[kind]}")
    return struct.pack(f"<iiQQ{len(values)}d", int(number), kind, int(width), int(height), *map(decimal, values))


def picture(line: str, after: str) -> bytes:
    """``ID QW QX QY QZ TX TY TZ CAMERA NAME``, and on the line ``after`` triples ``X Y POINT``."""
    number, *pose, camera_number, name = line.split(maxsplit=9)
    seen = after.split()
    if len(seen) % 3:
        raise ValueError(f"{len(seen)} numbers on the line after it, which holds three a point, or is empty")
    points = b"".join(
        struct.pack("<ddq", decimal(x), decimal(y), int(point))
        for x, y, point in zip(seen[::3], seen[1::3], seen[2::3], strict=True)
    )
    head = struct.pack("<i7di", int(number), *map(decimal, pose), int(camera_number))
    return head + name.encode() + b"\0" + struct.pack("<Q", len(seen) // 3) + points


def point(line: str, _: str) -> bytes:
    """``ID X Y Z R G B ERROR TRACK...``, whose colour, error and track nobody asks for."""
    number, x, y, z, *_ = line.split()
    return struct.pack("<Q3d11xQ", int(number), decimal(x), decimal(y), decimal(z), 0)


RECORDS: dict[str, tuple[Callable[[str, str], bytes], str]] = {
    "cameras": (camera, "ID MODEL WIDTH HEIGHT PARAMETERS"),
    "images": (picture, "ID QW QX QY QZ TX TY TZ CAMERA NAME, and its points on the next line"),
    "points3D": (point, "ID X Y Z R G B ERROR TRACK"),
}
"""What a line of each file is, by the file's stem."""


def as_binary(path: Path) -> tuple[bytes, list[tuple[int, int]]]:
    """Read ``cameras.txt``, ``images.txt`` or ``points3D.txt``.

    Returns:
        What COLMAP's binary file of that name would hold, and for each of its records where it begins there and on
        which line of the text it stands.

    Raises:
        DataError: it cannot be read, or a line is none of the file's; the message names the line.
    """
    record, expected = RECORDS[path.stem]
    content = read_bytes(path, "a file of COLMAP's text model")
    lines = enumerate(content.decode(json.detect_encoding(content), "replace").splitlines(), 1)  # also Windows' UTF-16
    parts, places, length = [], [], 8  # the count comes first
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        after = next(lines, (0, ""))[1] if record is picture else ""
        try:
            parts.append(record(line.strip(), after))
        except (ValueError, KeyError, struct.error, OverflowError) as error:
            raise DataError(path, f"line {number}, {line!r} ({error})", expected) from error
        places.append((length, number))
        length += len(parts[-1])
    return struct.pack("<Q", len(parts)) + b"".join(parts), places
