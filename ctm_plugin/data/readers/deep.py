"""TIFF, OpenEXR and PNG of 16 bits by OpenImageIO: whole numbers as they are stored, floats as linear light."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt16
from PIL.ExifTags import Base
from torch import Tensor

from ctm_plugin.data.readers.folders import as_data_error, require_file
from ctm_plugin.data.readers.picture import (
    MAX_PIXELS,
    Lens,
    Opened,
    check_size,
    from_light,
    lens_of,
    unpremultiplied,
    upright_header,
)
from ctm_plugin.data.readers.profiles import as_srgb, foreign
from ctm_plugin.errors import DataError

EXPECTED = (
    "a whole TIFF or EXR, grey or RGB, with alpha or without, of 8 or 16 bits or floats, of at most "
    f"{MAX_PIXELS} pixels: copy it here again, or leave it out"
)
GREY, COLOUR = (("Y",), ("Y", "A")), (("R", "G", "B"), ("R", "G", "B", "A"))
LENS_NAMES = {
    Base.Make: "Make", Base.Model: "Model", Base.FocalLength: "Exif:FocalLength",
    Base.FocalLengthIn35mmFilm: "Exif:FocalLengthIn35mmFilm", Base.DigitalZoomRatio: "Exif:DigitalZoomRatio",
}  # fmt: skip
"""OpenImageIO's names of EXIF's tags, in the order of :class:`Lens`."""
WHOLE, LIGHT = ("uint8", "uint16"), ("half", "float", "double")
"""OpenImageIO's names of the number types of stored levels, and of those of linear light."""


@contextmanager
def opened_file(path: Path) -> Iterator[Any]:
    """Context with OpenImageIO's reader of a file, alpha as stored; unreadable files raise OSError."""
    import OpenImageIO as oiio  # a fifth of a second, of which few data sets have a use

    asked = oiio.ImageSpec()
    asked.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), asked)
    if file is None:
        raise OSError(oiio.geterror())
    try:
        yield file
    finally:
        file.close()


def numbers(file: Any) -> np.ndarray:
    """Read a file's first picture ``[H, W, C]``, in its stored number type; OSError: it is damaged."""
    spec = file.spec()
    found = file.read_image(0, 0, 0, spec.nchannels, spec.format)
    if found is None:
        raise OSError(file.geterror())
    return found


def colored(pixels: np.ndarray) -> np.ndarray:
    """Turn grey, with or without alpha, into colour ``[H, W, C]``, C = 3 or 4; colour stays as it is."""
    return pixels if pixels.shape[-1] > 2 else pixels[..., [0, 0, 0, *range(1, pixels.shape[-1])]]


def write_tiff(path: Path, codes: UInt16[np.ndarray, "h w 3"], orientation: int, lens: Lens) -> None:
    """Write sRGB of 16 bits, with EXIF's orientation and lens; OSError: it cannot be written."""
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(codes.shape[1], codes.shape[0], 3, "uint16")
    lens = lens._replace(film=lens.film and round(lens.film))  # EXIF has whole millimetres
    for name, value in (("Orientation", orientation), *zip(LENS_NAMES.values(), lens, strict=True)):
        if value is not None:
            spec.attribute(name, value)
    file = oiio.ImageOutput.create("tiff")
    if not (file.open(str(path), spec) and file.write_image(codes) and file.close()):
        raise OSError(file.geterror())


@contextmanager
def open_deep(path: Path) -> Iterator[Opened]:
    """Open a TIFF or an EXR. 16 bits, and 8 without an ICC profile, are taken for sRGB, floats for linear light.

    Raises a DataError for channels other than grey or RGB with alpha, and for a cropped EXR.
    """
    require_file(path, EXPECTED)
    with as_data_error(path, "a picture that cannot be read", EXPECTED), opened_file(path) as file:
        spec = file.spec()
        check_size(path, spec.width, spec.height, EXPECTED)
        names, kind = tuple(spec.channelnames), str(spec.format)
        if names not in GREY + COLOUR or kind not in WHOLE + LIGHT:
            raise DataError(path, f"channels {', '.join(names)} of {kind}", EXPECTED)
        window, display = spec.roi, spec.roi_full
        if (window.xbegin, window.xend, window.ybegin, window.yend) != (
            display.xbegin, display.xend, display.ybegin, display.yend
        ):  # fmt: skip
            raise DataError(path, f"a data window of {window}", f"all of its display window, {display}")
        profile = spec.getattribute("ICCProfile")
        profile = None if profile is None else bytes(profile)
        grey, deep, light = names in GREY, kind != "uint8", kind in LIGHT
        header = upright_header(spec.height, spec.width, "A" in names, deep, spec.get_int_attribute("Orientation", 1))

        def pixels() -> Tensor:
            stored = numbers(file)
            stored = colored(stored if deep else as_srgb(stored, profile, grey))
            stored = stored.astype(np.float32) / np.float32(1 if light else np.iinfo(stored.dtype).max)
            if header.alpha and not spec.get_int_attribute("oiio:UnassociatedAlpha"):
                stored = unpremultiplied(stored)
            return from_light(stored, path) if light else torch.from_numpy(stored).clamp_(max=1.0)

        tags = {tag: value for tag, name in LENS_NAMES.items() if (value := spec.getattribute(name)) is not None}
        yield Opened(header._replace(colours=foreign(profile, grey, deep, light), lens=lens_of(tags, tags)), pixels)
