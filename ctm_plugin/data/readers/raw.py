"""Raw pictures of cameras, developed in memory; needs the extra ``raw``."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from PIL import Image
from PIL.ExifTags import IFD
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.folders import read_bytes, require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Opened, check_size, exposure_of
from ctm_plugin.errors import CTMError


@contextmanager
def open_raw(path: Path, brightness: float = 1.0) -> Iterator[Opened]:
    """A raw picture, developed the same way for every picture of a scene, so that equal light gives equal colours.

    Black level subtracted, white level to 1, the camera's own white balance, sRGB's primaries; no automatic brightness,
    no look at what the picture shows; then times ``brightness``, clipped, and sRGB's curve. The picture stays as the
    sensor stands: poses are for those.
    """
    try:
        import rawpy
    except ImportError as error:
        raise CTMError(f"developing raw pictures needs rawpy: pip install -e '.[raw]' ({error})") from error
    expected = f"a raw picture that LibRaw can develop, of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        check_size(path, sizes.raw_width, sizes.raw_height, expected)

        def pixels() -> Tensor:
            linear = raw.postprocess(
                use_camera_wb=True,
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

        yield Opened(Header(sizes.height, sizes.width, alpha=False, deep=True), pixels)


def raw_exposure(path: Path) -> float | None:
    """The light that a raw picture took, see :func:`exposure_of`, by its own EXIF, which DNG may have on top.

    ``None``: it does not tell, or is none of the many kinds that are TIFFs inside.
    """
    exif = Image.Exif()
    try:
        exif.load(read_bytes(path, "a raw picture"))
        return exposure_of({**exif, **exif.get_ifd(IFD.Exif)})
    except (SyntaxError, struct.error, ValueError, KeyError, TypeError):  # what Pillow raises on other files
        return None
