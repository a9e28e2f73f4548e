"""Raw pictures of cameras (DNG), developed in memory; needs the extra ``raw``."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Decoder, Header, Opened
from ctm_plugin.errors import CTMError, DataError


def raw_decoder(brightness: Mapping[Path, float]) -> Decoder:
    """Opens DNG files as :func:`open_raw` does, each with the factor on its light that ``brightness`` holds.

    Raises:
        CTMError: rawpy is not installed.
    """
    try:
        import rawpy  # noqa: F401
    except ImportError as error:
        raise CTMError(f"developing raw pictures needs rawpy: pip install -e '.[raw]' ({error})") from error
    return lambda path: open_raw(path, brightness[path])


@contextmanager
def open_raw(path: Path, brightness: float = 1.0) -> Iterator[Opened]:
    """A raw picture, developed the same way for every picture of a scene, so that equal light gives equal colours.

    Black level subtracted, white level to 1, the camera's own white balance, sRGB's primaries; no automatic brightness,
    no look at what the picture shows; then times ``brightness``, clipped, and sRGB's curve. The picture stays as the
    sensor stands: poses are for those.

    Args:
        path: a DNG, or whatever else LibRaw reads.
        brightness: factor on the linear light, > 0.

    Raises:
        DataError: missing, not a raw picture, too large; also when developing fails.
    """
    import rawpy

    expected = f"a raw picture that LibRaw can develop, of at most {MAX_PIXELS} pixels"
    require_file(path, expected)
    with told(path, "a file that cannot be developed", expected), rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        if sizes.raw_width * sizes.raw_height > MAX_PIXELS:
            raise DataError(path, f"a raw picture of {sizes.raw_width}x{sizes.raw_height} pixels", expected)

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
