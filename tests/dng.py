"""The smallest DNG that a raw developer takes: one uncompressed strip of a Bayer pattern, RGGB."""

import struct
from pathlib import Path

import numpy as np

BLACK, WHITE = 512, 16000
NEUTRAL = (0.5, 1.0, 0.625)
"""What a white thing measures on the sensor."""
COLOR_MATRIX = np.array([[0.9, -0.3, -0.1], [-0.4, 1.2, 0.2], [-0.05, 0.15, 0.7]])
"""CIE XYZ to the camera's colours."""
SRGB_TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)


def mosaic(camera: np.ndarray) -> np.ndarray:
    """``[H, W]`` sensor values of a picture ``[H, W, 3]`` in the camera's colours, 1 for the white level."""
    height, width, _ = camera.shape
    row, column = np.mgrid[:height, :width]
    chosen = np.take_along_axis(camera, ((row % 2) + (column % 2))[..., None], axis=2)[..., 0]
    return (BLACK + chosen * (WHITE - BLACK)).round().clip(0, 65535).astype(np.uint16)


def camera_to_srgb(camera: np.ndarray) -> np.ndarray:
    """Linear sRGB in [0, 1] of colours ``[..., 3]`` of the camera, as the DNG specification has it.

    White balance divides by the neutral colour, scaled so that no channel loses light; the matrix from sRGB to the
    camera has rows that sum to one, as white is white in both.
    """
    balanced = (camera * (np.max(NEUTRAL) / np.array(NEUTRAL))).clip(max=1.0)
    matrix = COLOR_MATRIX @ SRGB_TO_XYZ
    matrix /= matrix.sum(axis=1, keepdims=True)
    return (balanced @ np.linalg.inv(matrix).T).clip(0, 1)


def write_dng(path: Path, camera: np.ndarray, orientation: int = 1, seconds: float | None = None) -> None:
    """Write a picture ``[H, W, 3]`` in the camera's colours, H and W even; with its exposure time if given."""
    sensor = mosaic(camera)
    height, width = sensor.shape
    shorts, longs, texts, rationals, signed = 3, 4, 2, 5, 10

    def fractions(values) -> bytes:
        return b"".join(struct.pack("<ii", round(float(value) * 10000), 10000) for value in np.ravel(values))

    tags = [
        (254, longs, 1, struct.pack("<I", 0)),
        (256, longs, 1, struct.pack("<I", width)),
        (257, longs, 1, struct.pack("<I", height)),
        (258, shorts, 1, struct.pack("<H", 16)),
        (259, shorts, 1, struct.pack("<H", 1)),
        (262, shorts, 1, struct.pack("<H", 32803)),
        (271, texts, 5, b"Test\0"),
        (272, texts, 5, b"Test\0"),
        (273, longs, 1, b""),  # the strip's place, filled in below
        (274, shorts, 1, struct.pack("<H", orientation)),
        (277, shorts, 1, struct.pack("<H", 1)),
        (278, longs, 1, struct.pack("<I", height)),
        (279, longs, 1, struct.pack("<I", sensor.nbytes)),
        (33421, shorts, 2, struct.pack("<HH", 2, 2)),
        (33422, 1, 4, bytes([0, 1, 1, 2])),
        *([(33434, rationals, 1, fractions([seconds]))] if seconds else []),
        (50706, 1, 4, bytes([1, 4, 0, 0])),
        (50708, texts, 5, b"Test\0"),
        (50714, longs, 1, struct.pack("<I", BLACK)),
        (50717, longs, 1, struct.pack("<I", WHITE)),
        (50721, signed, 9, fractions(COLOR_MATRIX)),
        (50728, rationals, 3, fractions(NEUTRAL)),
        (50778, shorts, 1, struct.pack("<H", 21)),
    ]
    start = 8 + 2 + 12 * len(tags) + 4
    extra = b"".join(value for *_, value in tags if len(value) > 4)
    directory = struct.pack("<H", len(tags))
    place = start
    for tag, kind, count, value in tags:
        if tag == 273:
            value = struct.pack("<I", start + len(extra))
        if len(value) > 4:
            value, place = struct.pack("<I", place), place + len(value)
        directory += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
    path.write_bytes(struct.pack("<2sHI", b"II", 42, 8) + directory + b"\0" * 4 + extra + sensor.tobytes())
