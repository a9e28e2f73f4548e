"""Reading pictures, all checks included, and shrinking them."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float32, UInt8
from PIL import Image
from torch import Tensor

from ctm_plugin.data.readers.folders import reason, require_file
from ctm_plugin.errors import DataError

FORMATS = ("PNG", "JPEG", "WEBP")
MAX_PIXELS = 64_000_000
"""Pixels of the largest picture that is decoded, which takes 15 bytes for each: a small file can claim to hold far more
than memory does."""


warnings.filterwarnings("ignore", category=Image.DecompressionBombWarning)  # the limit is ours


class Header(NamedTuple):
    """What a picture says of itself before it is decoded."""

    height: int
    width: int
    alpha: bool


@contextmanager
def opened(path: Path) -> Iterator[Image.Image]:
    """The picture, not yet decoded.

    Raises:
        DataError: missing, unreadable, not a picture, too large; also when decoding inside the ``with`` fails.
    """
    expected = f"a whole image ({', '.join(FORMATS)}) of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    try:
        with Image.open(path, formats=FORMATS) as image:
            width, height = image.size
            if width * height > MAX_PIXELS:
                raise DataError(path, f"an image of {width}x{height} pixels", expected)
            yield image
    except DataError:
        raise
    except Image.UnidentifiedImageError as error:
        raise DataError(path, "something that is not an image", expected) from error
    except Exception as error:
        # The decoders raise whatever their parsers raise: OSError, SyntaxError, struct.error, zlib.error, ...
        raise DataError(path, f"an image that cannot be read ({reason(error)})", expected) from error


def read_header(path: Path) -> Header:
    """Size and kind of a picture without decoding it.

    Raises:
        DataError: see :func:`opened`.
    """
    with opened(path) as image:
        return Header(image.height, image.width, image.has_transparency_data)


def read_image(path: Path) -> Float32[Tensor, "h w c"]:
    """A picture as stored: ``[H, W, C]`` in [0, 1], C = 4 with straight alpha where the file has it, else 3.

    Grey becomes colour, palettes are looked up, 16-bit grey keeps its bits, 16-bit colour its upper 8.

    Raises:
        DataError: see :func:`opened`.
    """
    with opened(path) as image:
        if image.mode.startswith("I"):
            grey = torch.from_numpy(np.asarray(image).astype(np.float32) / np.float32(65535.0))
            return grey[..., None].expand(-1, -1, 3).contiguous()
        pixels = np.array(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    return torch.from_numpy(pixels).to(torch.float32).div_(255.0)


class Reader(NamedTuple):
    """How one kind of picture is read: as :func:`read_header` and :func:`read_image` do."""

    header: Callable[[Path], Header]
    image: Callable[[Path], Tensor]


PICTURES = Reader(read_header, read_image)
"""PNG, JPEG and WebP."""


def read_depth(path: Path, scale: float) -> Float32[Tensor, "h w"]:
    """Depth times ``scale``, from a 16-bit grey picture, NaN where its code is 0 (nothing was hit), or from a ``.npy``.

    Args:
        path: the picture or the array ``[H, W]``, distances > 0, or NaN where nothing was hit.
        scale: scene units a step, > 0.

    Raises:
        DataError: see :func:`opened`; or it holds something else.
    """
    if path.suffix == ".npy":
        return torch.from_numpy(read_array(path) * np.float32(scale))
    with opened(path) as image:
        if not image.mode.startswith("I"):
            raise DataError(path, f"a picture of kind {image.mode}", "depth as 16-bit grey")
        code = torch.from_numpy(np.asarray(image).astype(np.float32))
    return torch.where(code == 0, torch.nan, code * scale)


def read_array(path: Path) -> Float32[np.ndarray, "h w"]:
    """``[H, W]`` distances out of a ``.npy``.

    Raises:
        DataError: it cannot be read, or is no such array.
    """
    expected = "an array [H, W] of floats > 0, NaN for nothing"
    array = map_numbers(path, expected)
    if array.ndim != 2:
        raise DataError(path, f"an array {list(array.shape)}", expected)
    array = np.array(array, dtype=np.float32)
    if np.isinf(array).any() or (array <= 0).any():
        raise DataError(path, "a distance that is not > 0 or is infinite", expected)
    return array


def map_numbers(path: Path, expected: str) -> np.ndarray:
    """An array of floats out of a ``.npy``, mapped: the file's own length bounds what its header may claim.

    Raises:
        DataError: it cannot be read, or holds something else than floats.
    """
    require_file(path, expected)
    try:
        array = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:
        # numpy's parser of headers raises whatever Python's does: SyntaxError, TokenError, OverflowError, ...
        raise DataError(path, f"no array that can be read ({reason(error)})", expected) from error
    if array.dtype.kind != "f":
        raise DataError(path, f"an array of {array.dtype}, {list(array.shape)}", expected)
    return array


def shrink(image: Float32[Tensor, "h w c"], factor: int) -> Float32[Tensor, "h2 w2 c"]:
    """Box average over ``factor`` x ``factor`` pixels; with alpha, of premultiplied colour: ``mean(a c) / mean(a)``.

    Args:
        image: ``[H, W, 3]``, or ``[H, W, 4]`` with straight alpha, in [0, 1].
        factor: >= 1, a divisor of both sides.

    Returns:
        ``[H/factor, W/factor, C]``, straight alpha; colour is 0 where alpha is 0.
    """
    if factor == 1:
        return image
    if image.shape[-1] == 4:
        alpha = image[..., 3:]
        image = torch.cat([image[..., :3] * alpha, alpha], dim=-1)
    small = F.avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)
    if image.shape[-1] == 3:
        return small
    colour, alpha = small[..., :3], small[..., 3:]
    colour = torch.where(alpha > 0, colour / alpha.clamp(min=1e-12), 0.0).clamp(max=1.0)
    return torch.cat([colour, alpha], dim=-1)


def shrink_depth(depth: Float32[Tensor, "h w"], factor: int) -> Float32[Tensor, "h2 w2"]:
    """The depth nearest to each larger pixel's centre: averages over an edge would lie on no surface.

    Args:
        depth: ``[H, W]``, NaN where nothing was hit.
        factor: >= 1, a divisor of both sides. An even one has no pixel at the centre: the one below right is taken.
    """
    return depth[factor // 2 :: factor, factor // 2 :: factor]


def to_8_bits(image: Float32[Tensor, "h w c"]) -> UInt8[Tensor, "h w c"]:
    """``round(255 c)``; colour is 0 where the rounded alpha is 0."""
    levels = (image * 255.0).round().clamp(0, 255).to(torch.uint8)
    if levels.shape[-1] == 4:
        levels[levels[..., 3] == 0] = 0
    return levels
