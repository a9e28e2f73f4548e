"""PNG from its raw parts; PIL cannot write 16-bit colour."""

import struct
import zlib

import numpy as np


def png(width: int, height: int, bits: int, kind: int, data: bytes, extra: bytes = b"") -> bytes:
    """A picture of ``bits`` a channel, of PNG's colour type ``kind``, its rows filtered already; ``extra`` chunks."""
    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + extra
        + chunk(b"IDAT", zlib.compress(data))
        + chunk(b"IEND", b"")
    )


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png_16(code: np.ndarray, extra: bytes = b"") -> bytes:
    """``[H, W, C]`` uint16, 1 to 4 channels, each row by another of PNG's five filters."""
    height, width, channels = code.shape
    step = 2 * channels
    rows = code.astype(">u2").view(np.uint8).reshape(height, -1).astype(int)
    above, data = np.zeros(rows.shape[1], int), b""
    for index, row in enumerate(rows):
        left, corner = (np.concatenate([np.zeros(step, int), each[:-step]]) for each in (row, above))
        base = left + above - corner
        off = np.abs(np.stack([left, above, corner]) - base)
        paeth = np.choose(off.argmin(0), [left, above, corner])
        guess = [0, left, above, (left + above) // 2, paeth][index % 5]
        data += bytes([index % 5]) + ((row - guess) % 256).astype(np.uint8).tobytes()
        above = row
    return png(width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], data, extra)
