"""OpenEXR: linear light; needs the extra ``exr``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.data.readers.folders import require_file, told
from ctm_plugin.data.readers.picture import MAX_PIXELS, Header, Reader, check_size, from_light, unpremultiplied
from ctm_plugin.errors import CTMError, DataError

EXPECTED = f"a whole EXR of one part with channels R, G, B, and A or none, of at most {MAX_PIXELS} pixels"
CHANNELS = (("R", "G", "B"), ("R", "G", "B", "A"))


@contextmanager
def opened_exr(path: Path, header_only: bool) -> Iterator[Any]:
    """The file, decoded unless ``header_only``.

    Raises:
        CTMError: OpenEXR is not installed.
        DataError: missing, unreadable, too large, of another kind.
    """
    try:
        import OpenEXR
    except ImportError as error:
        raise CTMError(f"reading {path.name} needs OpenEXR: pip install -e '.[exr]' ({error})") from error
    require_file(path, EXPECTED)
    with (
        told(path, "an EXR that cannot be read", EXPECTED),
        OpenEXR.File(str(path), separate_channels=True, header_only=header_only) as file,
    ):
        yield file


def exr_header(path: Path) -> Header:
    """Size and kind of an EXR without decoding it.

    Raises:
        CTMError, DataError: see :func:`opened_exr`.
    """
    with opened_exr(path, header_only=True) as file:
        header = file.header()
        if len(file.parts) > 1:
            raise DataError(path, f"{len(file.parts)} parts", EXPECTED)
        names = tuple(sorted((channel.name for channel in header["channels"]), key="RGBA".find))
        if names not in CHANNELS:
            raise DataError(path, f"channels {', '.join(names)}", EXPECTED)
        (low, high), (first, last) = header["dataWindow"], header["displayWindow"]
        if (low != first).any() or (high != last).any():
            expected = f"all of its display window, {first.tolist()} to {last.tolist()}"
            raise DataError(path, f"a data window {low.tolist()} to {high.tolist()}", expected)
        width, height = (high.astype(int) - low + 1).tolist()
        check_size(path, width, height, EXPECTED)
        return Header(height, width, "A" in names, deep=True)


def read_exr(path: Path) -> Float32[Tensor, "h w c"]:
    """An EXR's picture, ``[H, W, C]``, C = 4 with straight alpha where it has it (the file's is multiplied in), else 3.

    Raises:
        CTMError, DataError: see :func:`opened_exr`, or a number is NaN or infinite.
    """
    header = exr_header(path)
    with opened_exr(path, header_only=False) as file:
        channels = file.channels()
        planes = [np.asarray(channels[name].pixels, np.float32) for name in CHANNELS[header.alpha]]
        light = np.stack(planes, axis=-1)
    return from_light(unpremultiplied(light) if header.alpha else light, path)


EXR = Reader(exr_header, read_exr)
