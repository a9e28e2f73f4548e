"""Raw pictures of cameras, developed in memory; needs the extra ``raw``."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import torch
from PIL import Image
from PIL.ExifTags import IFD
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.folders import read_bytes, require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Opened, check_size, exposure_of
from ctm_plugin.errors import CTMError


@contextmanager
def open_raw(
    path: Path, brightness: float = 1.0, balance: Sequence[float] | None = None, half: bool = False
) -> Iterator[Opened]:
    """Open a raw picture, developed alike for all pictures of a scene, so that equal light gives equal colours.

    Black level subtracted, white level to 1, the camera's own white balance, sRGB's primaries; no automatic brightness,
    nothing that depends on the picture; then times ``brightness``, clipped, and sRGB's curve. The picture is not
    turned: poses are for pictures as the sensor stands.

    Args:
        path: the file.
        brightness: factor on the light.
        balance: factors on red, green, blue and the second green in place of the camera's own.
        half: a pixel for each four of the sensor's, so that no colour is made up from those next to it.
    """
    rawpy = require_rawpy()
    expected = f"a raw picture that LibRaw can develop, of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        check_size(path, sizes.raw_width, sizes.raw_height, expected)

        def pixels() -> Tensor:
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
    """Import rawpy, LibRaw's module, or name the extra that is missing."""
    try:
        import rawpy
    except ImportError as error:
        raise CTMError(f"developing raw pictures needs rawpy: pip install -e '.[raw]' ({error})") from error
    return rawpy


class RawHeader(NamedTuple):
    """Metadata of a raw picture.

    Attributes:
        side: the longer side in pixels.
        orientation: the turn that makes it upright, in EXIF's numbers.
        balance: the camera's factors on red, green, blue and the second green.
        exposure: see :func:`raw_exposure`.
    """

    side: int
    orientation: int
    balance: tuple[float, ...]
    exposure: float | None


def read_raw(path: Path) -> RawHeader:
    """Read a raw picture's metadata, without developing it."""
    rawpy = require_rawpy()
    expected = "a raw picture that LibRaw can develop: copy it here again, or leave it out"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes, balance = raw.sizes, tuple(raw.camera_whitebalance)
    side, turned = max(sizes.height, sizes.width), {3: 3, 5: 8, 6: 6}.get(sizes.flip, 1)
    return RawHeader(side, turned, balance, raw_exposure(path))


def raw_exposure(path: Path) -> float | None:
    """Exposure of a raw picture by its EXIF, see :func:`exposure_of`; a DNG may have it in its first directory.

    ``None``: EXIF does not give it, or the file is not based on TIFF, as most raw formats are.
    """
    exif = Image.Exif()
    try:
        exif.load(read_bytes(path, "a raw picture"))
        return exposure_of({**exif, **exif.get_ifd(IFD.Exif)})
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # what Pillow raises on other files
        return None
