"""Raw pictures of cameras, developed in memory; needs the extra ``raw``."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, UInt16
from PIL import Image
from PIL.ExifTags import IFD
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.folders import read_bytes, require_file, told
from ctm_plugin.data.readers.hot_pixels import repair
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Lens, Opened, check_size, exposure_of, lens_of
from ctm_plugin.errors import CTMError


@contextmanager
def open_raw(
    path: Path, brightness: float = 1.0, balance: Sequence[float] | None = None, half: bool = False,
    hot: Bool[np.ndarray, "h w"] | None = None,
) -> Iterator[Opened]:  # fmt: skip
    """Open a raw picture, developed alike for all pictures of a scene, so that equal light gives equal colours.

    Black level subtracted, white level to 1, the camera's own white balance, sRGB's primaries; no automatic brightness,
    nothing that depends on the picture; then times ``brightness``, at most 1, and sRGB's curve. Noise below the black
    level is below 0: cut off, it would leave the dark too bright. The picture is not turned: poses are for pictures as
    the sensor stands.

    Args:
        path: the file.
        brightness: factor on the light.
        balance: factors on red, green, blue and the second green in place of the camera's own.
        half: a pixel for each four of the sensor's, so that no colour is made up from those next to it.
        hot: pixels of the sensor that are repaired, see :func:`~ctm_plugin.data.readers.hot_pixels.hot_pixels`.
    """
    rawpy = require_rawpy()
    expected = f"a raw picture that LibRaw can develop, of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        check_size(path, sizes.raw_width, sizes.raw_height, expected)

        def pixels() -> Tensor:
            given = raw.camera_whitebalance if balance is None else balance
            factors = np.array(given if any(given) else raw.daylight_whitebalance, float)
            black = np.array(raw.black_level_per_channel)
            lift, top = black.max(), raw.white_level - black.max()
            lifted = raw.raw_type == rawpy.RawType.Flat and lift > 0

            def developed(half: bool) -> np.ndarray:
                return raw.postprocess(
                    user_wb=[*factors],
                    half_size=half,
                    output_color=rawpy.ColorSpace.sRGB,
                    output_bps=16,
                    gamma=(1, 1),
                    no_auto_bright=True,
                    adjust_maximum_thr=0.0,
                    user_flip=0,
                    **({"user_black": 0, "user_sat": int(top + lift)} if lifted else {}),
                )

            if hot is not None:
                repair(raw.raw_image_visible, hot)
            zero, scale = [0, 0, 0], 1 / 65535
            if lifted:
                # LibRaw cuts off what is below black: black becomes a grey, after the balance, that is taken off later.
                mosaic, colors = raw.raw_image_visible, raw.raw_colors_visible
                grey = np.round(lift * factors[factors > 0].min() / np.where(factors > 0, factors, factors[1]))
                shift = (grey - black).astype(np.int32)
                mosaic[:] = (mosaic + shift[colors]).clip(0, 65535)
                scale *= (top + lift) / top
            codes = developed(half)
            if lifted:
                mosaic[:] = grey[colors]
                zero = np.median(developed(True), (0, 1))
            levels = torch.arange(65536, dtype=torch.float32)
            light = [((levels - level) * (scale * brightness)).clamp(max=1.0) for level in zero]
            # Tables: all pixels' light in float would take a gigabyte.
            channels = [linear_to_srgb(each).numpy()[codes[..., index]] for index, each in enumerate(light)]
            return torch.from_numpy(np.stack(channels, -1))

        height, width = ((side + half) // (1 + half) for side in (sizes.height, sizes.width))
        yield Opened(Header(height, width, alpha=False, deep=True), pixels)


def require_rawpy() -> ModuleType:
    """Import rawpy, LibRaw's module, or name the extra that is missing."""
    try:
        import rawpy
    except ImportError as error:
        raise CTMError(f"developing raw pictures needs rawpy: pip install -e '.[raw]' ({error})") from error
    return rawpy


class RawHeader(NamedTuple):
    """Metadata of a raw picture.

    Attributes:
        sensor: height and width in pixels.
        orientation: the turn that makes it upright, in EXIF's numbers.
        balance: the camera's factors on red, green, blue and the second green.
        exposure: see :func:`exposure_of`.
        lens: by its EXIF.
    """

    sensor: tuple[int, int]
    orientation: int
    balance: tuple[float, ...]
    exposure: float | None
    lens: Lens


def read_raw(path: Path) -> RawHeader:
    """Read a raw picture's metadata, without developing it."""
    rawpy = require_rawpy()
    expected = "a raw picture that LibRaw can develop: copy it here again, or leave it out"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes, balance = raw.sizes, tuple(raw.camera_whitebalance)
    turned, tags = {3: 3, 5: 8, 6: 6}.get(sizes.flip, 1), raw_exif(path)
    return RawHeader((sizes.height, sizes.width), turned, balance, exposure_of(tags), lens_of(tags, tags))


def read_mosaic(path: Path) -> UInt16[np.ndarray, "h w"] | None:
    """Read a sensor's values of a raw picture; ``None``: it has no Bayer pattern."""
    with told(path, "a file that cannot be developed", "a raw picture"), require_rawpy().imread(str(path)) as raw:
        bayer = raw.raw_pattern is not None and raw.raw_pattern.shape == (2, 2)
        return raw.raw_image_visible.copy() if bayer else None


def raw_exif(path: Path) -> dict[int, Any]:
    """Read a raw picture's EXIF; a DNG may have it in its first directory.

    Empty: the file is not based on TIFF, as most raw formats are.
    """
    exif = Image.Exif()
    try:
        exif.load(read_bytes(path, "a raw picture"))
        return {**exif, **exif.get_ifd(IFD.Exif)}
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # what Pillow raises on other files
        return {}
