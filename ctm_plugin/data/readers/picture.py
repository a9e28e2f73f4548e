"""Parts that all decoders of pictures share: header, size limit, EXIF's orientation and exposure."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32
from PIL import ExifTags
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.errors import DataError
from ctm_plugin.scene.views import Pixels

MAX_PIXELS = 64_000_000
"""Largest number of pixels of a picture to decode, at 15 bytes each: a small file can claim more than memory holds."""
UPRIGHT_ORIENTATION = 1
"""EXIF's orientation of a picture that is stored upright."""


class Lens(NamedTuple):
    """Camera, lens and focal length by EXIF; ``None`` where EXIF does not give one.

    Attributes:
        maker, model: the camera's maker and model.
        focal: the lens's focal length in millimetres.
        film: focal length of the same field of view on 35 mm film, in millimetres.
        zoom: factor of digital zoom.
    """

    maker: str | None = None
    model: str | None = None
    focal: float | None = None
    film: float | None = None
    zoom: float | None = None


class Header(NamedTuple):
    """Metadata of a picture before it is decoded.

    Attributes:
        height, width: in pixels, of the picture turned upright.
        alpha: whether it has transparency.
        deep: whether it holds more than 8 bits a channel.
        orientation: the turn that makes it upright, in EXIF's numbers, 1 to 8; 1: none.
        exposure: exposure by EXIF, see :func:`exposure_of`; ``None``: EXIF does not give it.
        colours: name of its colours where they are not sRGB's and are not converted.
        lens: camera and lens by EXIF, see :class:`Lens`.
    """

    height: int
    width: int
    alpha: bool
    deep: bool = False
    orientation: int = UPRIGHT_ORIENTATION
    exposure: float | None = None
    colours: str | None = None
    lens: Lens = Lens()

    def as_stored(self) -> Header:
        """The header of the same picture without EXIF's turn."""
        height, width = (self.width, self.height) if self.orientation > 4 else (self.height, self.width)
        return self._replace(height=height, width=width, orientation=UPRIGHT_ORIENTATION)


class Opened(NamedTuple):
    """An open picture file: its header, and its pixels, decoded on demand.

    Attributes:
        header: see :class:`Header`.
        pixels: ``[H, W, 3]``, or ``[H, W, 4]`` with straight alpha, sRGB as the file stores them, not turned: 8 bits,
            or float32, in [0, 1] unless it holds linear light.
    """

    header: Header
    pixels: Callable[[], Pixels]


Decoder = Callable[[Path], AbstractContextManager[Opened]]
"""Opens pictures of one format; every fault of a file is a :class:`DataError`, inside the ``with`` too."""


def check_size(path: Path, width: int, height: int, expected: str) -> None:
    """Refuse pictures of more than ``MAX_PIXELS``."""
    if not 0 < width * height <= MAX_PIXELS:
        raise DataError(path, f"an image of {width}x{height} pixels", expected)


def upright_header(height: int, width: int, alpha: bool, deep: bool, orientation: int) -> Header:
    """Make the header of a picture stored in this size; orientations that EXIF does not define count as none."""
    orientation = orientation if 1 <= orientation <= 8 else UPRIGHT_ORIENTATION
    return Header(*((width, height) if orientation > 4 else (height, width)), alpha, deep, orientation)


def exposure_of(exif: Mapping[int, Any]) -> float | None:
    """Exposure of a picture, up to a factor of its camera: seconds x ISO / 100 / f-number².

    By EXIF's tags; ISO and f-number count as 100 and 1 where they are missing or no numbers > 0. ``None`` without an
    exposure time > 0.
    """
    tags = ExifTags.Base
    seconds, iso, f_number = (positive(exif, tag) for tag in (tags.ExposureTime, tags.ISOSpeedRatings, tags.FNumber))
    return seconds and seconds * (iso or 100.0) / 100.0 / (f_number or 1.0) ** 2


def lens_of(image: Mapping[int, Any], exif: Mapping[int, Any]) -> Lens:
    """Read the lens by EXIF's tags: of the picture's directory, ``image``, and of the EXIF directory, ``exif``."""
    tags = ExifTags.Base
    names = [str(image[tag]) if tag in image else None for tag in (tags.Make, tags.Model)]
    lengths = (tags.FocalLength, tags.FocalLengthIn35mmFilm, tags.DigitalZoomRatio)
    return Lens(*names, *(positive(exif, tag) for tag in lengths))


def positive(exif: Mapping[int, Any], tag: int) -> float | None:
    """Read an EXIF tag's number, the first of several; ``None`` where it is missing or no number > 0."""
    value = exif.get(tag)
    with suppress(TypeError, ValueError, ZeroDivisionError):
        number = float(value[0] if isinstance(value, tuple) and value else value)
        return number if 0 < number < math.inf else None


def turn(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Make a picture ``[H, W, C]`` upright: mirrored, turned or both, by EXIF's orientation."""
    if orientation in (2, 4, 5, 7):
        pixels = pixels[:, ::-1]
    return np.rot90(pixels, {3: 2, 4: 2, 5: 1, 6: -1, 7: -1, 8: 1}.get(orientation, 0))


def unpremultiplied(pixels: Float32[np.ndarray, "h w 4"]) -> Float32[np.ndarray, "h w 4"]:
    """Turn premultiplied alpha into straight alpha; colour is 0 where alpha is 0."""
    colour, alpha = pixels[..., :3], pixels[..., 3:]
    return np.concatenate([np.divide(colour, alpha, out=np.zeros_like(colour), where=alpha > 0), alpha], axis=-1)


def from_light(light: Float[np.ndarray, "h w c"], path: Path) -> Float32[Tensor, "h w c"]:
    """Encode linear light as sRGB, alpha unchanged; values outside [0, 1] stay outside. DataError: NaN or infinity."""
    if not np.isfinite(light).all():
        raise DataError(path, "NaN or infinity", "finite numbers")
    image = torch.from_numpy(np.ascontiguousarray(light, dtype=np.float32))
    return torch.cat([linear_to_srgb(image[..., :3]), image[..., 3:]], dim=-1)
