"""Raw pictures of cameras (DNG), developed in memory; needs the extra ``raw``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Reader
from ctm_plugin.errors import CTMError, DataError


def raw_reader(brightness: Mapping[Path, float]) -> Reader:
    """Reads DNG files as :func:`read_raw` does, each with the factor on its light that ``brightness`` holds.

    Raises:
        CTMError: rawpy is not installed.
    """
    try:
        import rawpy  # noqa: F401
    except ImportError as error:
        raise CTMError(f"developing raw pictures needs rawpy: pip install -e '.[raw]' ({error})") from error
    return Reader(raw_header, lambda path: read_raw(path, brightness[path]))


@contextmanager
def opened_raw(path: Path) -> Iterator[Any]:
    """The file, opened by LibRaw.

    Raises:
        DataError: missing, not a raw picture, too large; also when developing inside the ``with`` fails.
    """
    import rawpy

    expected = f"a raw picture that LibRaw can develop, of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        if raw.sizes.raw_width * raw.sizes.raw_height > MAX_PIXELS:
            found = f"a raw picture of {raw.sizes.raw_width}x{raw.sizes.raw_height} pixels"
            raise DataError(path, found, expected)
        yield raw


def raw_header(path: Path) -> Header:
    """Size of the picture that :func:`read_raw` gives, without developing it.

    Raises:
        DataError: see :func:`opened_raw`.
    """
    with opened_raw(path) as raw:
        return Header(raw.sizes.height, raw.sizes.width, alpha=False, deep=True)


def read_raw(path: Path, brightness: float = 1.0) -> Float32[Tensor, "h w 3"]:
    """A raw picture developed the same way for every picture of a scene, so that equal light gives equal colours.

    Black level subtracted, white level to 1, the camera's own white balance, sRGB's primaries; no automatic brightness,
    no look at what the picture shows; then times ``brightness``, clipped, and sRGB's curve. The picture stays as the
    sensor stands: poses are for those.

    Args:
        path: a DNG, or whatever else LibRaw reads.
        brightness: factor on the linear light, > 0.

    Returns:
        ``[H, W, 3]`` sRGB in [0, 1].

    Raises:
        DataError: see :func:`opened_raw`.
    """
    import rawpy

    with opened_raw(path) as raw:
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
