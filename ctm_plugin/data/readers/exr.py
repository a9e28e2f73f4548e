"""OpenEXR: linear light; needs the extra ``exr``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from torch import Tensor

from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Opened, check_size, from_light, unpremultiplied
from ctm_plugin.errors import CTMError, DataError

EXR_EXPECTED = f"a whole EXR of one part with channels R, G, B, and A or none, of at most {MAX_PIXELS} pixels"
EXR_CHANNELS = (("R", "G", "B"), ("R", "G", "B", "A"))
"""Names of channels that a picture may have."""


@contextmanager
def open_exr(path: Path) -> Iterator[Opened]:
    """The file's picture; its alpha is multiplied in."""
    try:
        import OpenEXR
    except ImportError as error:
        raise CTMError(f"reading {path.name} needs OpenEXR: pip install -e '.[exr]' ({error})") from error

    def pixels() -> Tensor:
        with OpenEXR.File(str(path), separate_channels=True) as whole:
            planes = [np.asarray(whole.channels()[name].pixels, np.float32) for name in names]
        light = np.stack(planes, axis=-1)
        return from_light(unpremultiplied(light) if "A" in names else light, path)

    require_file(path, EXR_EXPECTED)
    with (
        told(path, "an EXR that cannot be read", EXR_EXPECTED),
        OpenEXR.File(str(path), separate_channels=True, header_only=True) as file,
    ):
        header = file.header()
        if len(file.parts) > 1:
            raise DataError(path, f"{len(file.parts)} parts", EXR_EXPECTED)
        names = tuple(sorted((channel.name for channel in header["channels"]), key="RGBA".find))
        if names not in EXR_CHANNELS:
            raise DataError(path, f"channels {', '.join(names)}", EXR_EXPECTED)
        (low, high), (first, last) = header["dataWindow"], header["displayWindow"]
        if (low != first).any() or (high != last).any():
            expected = f"all of its display window, {first.tolist()} to {last.tolist()}"
            raise DataError(path, f"a data window {low.tolist()} to {high.tolist()}", expected)
        width, height = (high.astype(int) - low + 1).tolist()
        check_size(path, width, height, EXR_EXPECTED)
        yield Opened(Header(height, width, "A" in names, deep=True), pixels)
