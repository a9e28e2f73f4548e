"""TIFF by tifffile: 8 and 16 bits as they are stored, floats as linear light."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32
from tifffile import EXTRASAMPLE, PHOTOMETRIC, TiffFile, TiffPage
from torch import Tensor

from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import (
    MAX_PIXELS,
    Header,
    Reader,
    check_size,
    from_light,
    shown,
    turn,
    unpremultiplied,
)
from ctm_plugin.data.readers.profiles import as_srgb, foreign
from ctm_plugin.errors import DataError

EXPECTED = (
    f"a whole TIFF, grey or RGB, with alpha or without, of 8 or 16 bits or floats, of at most {MAX_PIXELS} pixels, not "
    "compressed or by Deflate (others need the package imagecodecs)"
)
AXES = {"YX": (1,), "YXS": (1, 2, 3, 4), "SYX": (1, 2, 3, 4)}
"""Orders of rows, columns and samples, and how many samples there may be."""
TYPES = ("uint8", "uint16", "float16", "float32", "float64")
ALPHA = ((EXTRASAMPLE.ASSOCALPHA,), (EXTRASAMPLE.UNASSALPHA,))


@contextmanager
def opened_tiff(path: Path) -> Iterator[TiffPage]:
    """The file's first page, not yet decoded.

    Raises:
        DataError: missing, unreadable, too large, of another kind; also when decoding inside the ``with`` fails.
    """
    require_file(path, EXPECTED)
    with told(path, "a TIFF that cannot be read", EXPECTED), TiffFile(path) as file:
        page = file.pages[0]
        check_size(path, page.imagewidth, page.imagelength, EXPECTED)
        samples = page.samplesperpixel
        known = samples in AXES.get(page.axes, ()) and str(page.dtype) in TYPES
        known = known and page.photometric == (PHOTOMETRIC.RGB if samples > 2 else PHOTOMETRIC.MINISBLACK)
        if not known or (samples in (2, 4) and page.extrasamples[:1] not in ALPHA):
            found = f"{page.axes} of {samples} samples, {page.dtype}, photometric {page.photometric!s}"
            raise DataError(path, f"{found}, more samples: {page.extrasamples}", EXPECTED)
        yield page


def tiff_header(path: Path) -> Header:
    """Size and kind of a TIFF without decoding it.

    Raises:
        DataError: see :func:`opened_tiff`.
    """
    with opened_tiff(path) as page:
        orientation = page.tags.valueof("Orientation", 1)
        deep, grey = page.dtype != np.uint8, page.samplesperpixel < 3
        header = shown(page.imagelength, page.imagewidth, page.samplesperpixel in (2, 4), deep, int(orientation))
        return header._replace(colours=foreign(profile_of(page), grey, deep, page.dtype.kind == "f"))


def profile_of(page: TiffPage) -> bytes | None:
    """The ICC profile."""
    found = page.tags.valueof("InterColorProfile")
    return bytes(found) if found else None


def read_tiff(path: Path) -> Float32[Tensor, "h w c"]:
    """A TIFF's first page, ``[H, W, C]``, C = 4 with straight alpha where the file has it, else 3.

    16 bits, and 8 without an ICC profile, are taken for sRGB, floats for linear light, which may lie outside [0, 1].

    Raises:
        DataError: see :func:`opened_tiff`, or a float is NaN or infinite.
    """
    header = tiff_header(path)
    with opened_tiff(path) as page:
        pixels, multiplied = page.asarray(), page.extrasamples[:1] == (EXTRASAMPLE.ASSOCALPHA,)
        pixels = np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels
        pixels = pixels.reshape(*pixels.shape[:2], -1)
        if pixels.dtype == np.uint8:
            pixels = as_srgb(pixels, profile_of(page), page.samplesperpixel < 3)
        light = pixels.dtype.kind == "f"
        pixels = pixels.astype(np.float32) / np.float32(1 if light else np.iinfo(pixels.dtype).max)
    if pixels.shape[-1] < 3:
        pixels = np.concatenate([pixels[..., :1]] * 3 + [pixels[..., 1:]], axis=-1)
    pixels = turn(unpremultiplied(pixels) if multiplied else pixels, header.orientation)
    return from_light(pixels, path) if light else torch.from_numpy(np.ascontiguousarray(pixels)).clamp_(max=1.0)


TIFF = Reader(tiff_header, read_tiff)
