"""TIFF by tifffile: 8 and 16 bits as they are stored, floats as linear light."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from tifffile import EXTRASAMPLE, PHOTOMETRIC, TiffFile
from torch import Tensor

from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Opened, check_size, from_light, unpremultiplied, upright_header
from ctm_plugin.data.readers.profiles import as_srgb, foreign
from ctm_plugin.errors import DataError

TIFF_EXPECTED = (
    f"a whole TIFF, grey or RGB, with alpha or without, of 8 or 16 bits or floats, of at most {MAX_PIXELS} pixels, not "
    "compressed or by Deflate (others need the package imagecodecs)"
)
TIFF_AXES = {"YX": (1,), "YXS": (1, 2, 3, 4), "SYX": (1, 2, 3, 4)}
"""Orders of rows (Y), columns (X) and samples (S), and how many samples each may have."""
TIFF_TYPES = ("uint8", "uint16", "float16", "float32", "float64")
"""Types of numbers that are read."""
ALPHA_SAMPLES = ((EXTRASAMPLE.ASSOCALPHA,), (EXTRASAMPLE.UNASSALPHA,))
"""TIFF's extra samples that are alpha."""


@contextmanager
def open_tiff(path: Path) -> Iterator[Opened]:
    """The file's first page. 16 bits, and 8 without an ICC profile, are taken for sRGB, floats for linear light."""
    require_file(path, TIFF_EXPECTED)
    with told(path, "a TIFF that cannot be read", TIFF_EXPECTED), TiffFile(path) as file:
        page = file.pages[0]
        check_size(path, page.imagewidth, page.imagelength, TIFF_EXPECTED)
        samples, extra = page.samplesperpixel, page.extrasamples[:1]
        known = samples in TIFF_AXES.get(page.axes, ()) and str(page.dtype) in TIFF_TYPES
        known = known and page.photometric == (PHOTOMETRIC.RGB if samples > 2 else PHOTOMETRIC.MINISBLACK)
        if not known or (samples in (2, 4) and extra not in ALPHA_SAMPLES):
            found = f"{page.axes} of {samples} samples, {page.dtype}, photometric {page.photometric!s}"
            raise DataError(path, f"{found}, more samples: {page.extrasamples}", TIFF_EXPECTED)
        profile = page.tags.valueof("InterColorProfile")
        profile = bytes(profile) if profile else None
        deep, light, grey = page.dtype != np.uint8, page.dtype.kind == "f", samples < 3
        orientation = int(page.tags.valueof("Orientation", 1))
        header = upright_header(page.imagelength, page.imagewidth, samples in (2, 4), deep, orientation)

        def pixels() -> Tensor:
            stored = page.asarray()
            stored = np.moveaxis(stored, 0, -1) if page.axes == "SYX" else stored
            stored = stored.reshape(*stored.shape[:2], -1)
            stored = stored if deep else as_srgb(stored, profile, grey)
            stored = stored.astype(np.float32) / np.float32(1 if light else np.iinfo(stored.dtype).max)
            if stored.shape[-1] < 3:
                stored = np.concatenate([stored[..., :1]] * 3 + [stored[..., 1:]], axis=-1)
            stored = unpremultiplied(stored) if extra == ALPHA_SAMPLES[0] else stored
            return from_light(stored, path) if light else torch.from_numpy(stored).clamp_(max=1.0)

        yield Opened(header._replace(colours=foreign(profile, grey, deep, light)), pixels)
