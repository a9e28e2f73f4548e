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
from ctm_plugin.data.readers.folders import as_data_error, require_file
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
    nothing that depends on the picture; then times ``brightness``, clipped, and sRGB's curve. The picture is not
    turned: poses are for pictures as the sensor stands.

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
    with as_data_error(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        check_size(path, sizes.raw_width, sizes.raw_height, expected)

        def pixels() -> Tensor:
            if hot is not None:
                repair(raw.raw_image_visible, hot)
            linear = raw.postprocess(
                use_camera_wb=balance is None,
                user_wb=None if balance is None else [*balance],
                half_size=half,
                output_color=rawpy.ColorSpace.sRGB,
                output_bps=16,
                gamma=(1, 1),
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_flip=0,
            )
            levels = torch.arange(65536, dtype=torch.float32) / 65535.0
            table = linear_to_srgb((levels * brightness).clamp(max=1.0))
            return torch.from_numpy(table.numpy()[linear])  # all pixels' light in float would take a gigabyte

        height, width = ((side + half) // (1 + half) for side in (sizes.height, sizes.width))
        yield Opened(Header(height, width, alpha=False, deep=True), pixels)


def require_rawpy() -> ModuleType:
    """Import rawpy, LibRaw's module, else raise a CTMError that names the extra."""
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
    """Read a raw picture's metadata, without developing it; DataError: LibRaw cannot read it."""
    rawpy = require_rawpy()
    expected = "a raw picture that LibRaw can develop: copy it here again, or leave it out"
    require_file(path, expected)
    with as_data_error(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes, balance = raw.sizes, tuple(raw.camera_whitebalance)
    turned, tags = {3: 3, 5: 8, 6: 6}.get(sizes.flip, 1), raw_exif(path)
    return RawHeader((sizes.height, sizes.width), turned, balance, exposure_of(tags), lens_of(tags, tags))


def read_mosaic(path: Path) -> UInt16[np.ndarray, "h w"] | None:
    """Read a sensor's values of a raw picture; ``None``: it has no Bayer pattern."""
    with (
        as_data_error(path, "a file that cannot be developed", "a raw picture"),
        require_rawpy().imread(str(path)) as raw,
    ):
        bayer = raw.raw_pattern is not None and raw.raw_pattern.shape == (2, 2)
        return raw.raw_image_visible.copy() if bayer else None


def raw_exif(path: Path) -> dict[int, Any]:
    """Read a raw picture's EXIF; a DNG may have it in its first directory.

    Empty: the file is not based on TIFF, as most raw formats are.
    """
    exif = Image.Exif()
    require_file(path, "a raw picture")
    try:
        with path.open("rb") as file:
            exif.load_from_fp(file)
            return {**exif, **exif.get_ifd(IFD.Exif)}
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # what Pillow raises on other files
        return {}
