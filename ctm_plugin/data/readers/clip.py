"""Clips of phones and cameras by ffmpeg: small grey frames to look at, and chosen ones written as pictures.

Frames are counted as they are stored, whatever their times say, and turned as the clip asks.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from jaxtyping import Float32

from ctm_plugin.data.readers.folders import as_data_error, require_file
from ctm_plugin.errors import CTMError, DataError

CLIP_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".3gp", ".mts", ".m2ts")
"""Suffixes of clips."""
CLIP_EXPECTED = "a whole clip that ffmpeg can read: copy it here again, or leave it out"
WATCHED_SIDE, FRAME_SIDE = 960, 1920
"""Longer side in pixels of frames whose movement is measured, and of those that are written; larger ones are
averaged."""
HDR_WHITE = 203
"""Light of white paper in HLG and PQ, cd/m² (ITU-R BT.2408)."""
HDR_CURVES = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
"""Transfer functions of HDR by ffmpeg's names."""
WIDE_PRIMARIES = ("bt2020", "smpte431", "smpte432")
"""ffmpeg's names of primaries that are neither sRGB's nor close to them."""
MATRIX = re.compile("bt|smpte|fcc|gbr|ycgco|ictcp").match
"""Function that matches ffmpeg's name of a YCbCr matrix."""
NO_MATCH = re.match("(x)?(x)?(x)?", "")
"""A match without groups, where ffmpeg names no duration or rate."""
HD = 720
"""Lines from which a clip without a tag has BT.709's matrix, as players assume; fewer have BT.601's."""


class ClipHeader(NamedTuple):
    """Metadata of a clip by ffmpeg.

    Attributes:
        count: approximate number of frames; 0: unknown.
        curve: ffmpeg's name of the transfer function HLG or PQ; empty: the clip is not HDR.
        primaries: ffmpeg's name of the colour primaries; empty: sRGB's, or nearly.
        deep: whether it has more than 8 bits.
        matrix: the YCbCr matrix to assume where the clip names none; empty: it names one.
    """

    count: int
    curve: str
    primaries: str
    deep: bool
    matrix: str


def read_clip(path: Path) -> ClipHeader:
    """Read a clip's metadata, without decoding it.

    Raises:
        DataError: the file is no clip, or a damaged one.
    """
    require_file(path, CLIP_EXPECTED)
    output = subprocess.run(_ffmpeg(path), capture_output=True, text=True, errors="replace").stderr
    if " Video: " not in output:
        if "Input #0" in output:
            raise DataError(path, "no moving pictures", CLIP_EXPECTED)
        with as_data_error(path, "a clip that cannot be read", CLIP_EXPECTED):
            raise OSError(_first(output))
    return header_of(output)


def header_of(output: str) -> ClipHeader:
    """Parse a clip's header out of the text that ffmpeg prints.

    Example:
        >>> header_of("Video: hevc (Main 10), yuv420p10le(tv, bt2020nc/bt2020/arib-std-b67), 1920x1080, 30 fps")
        ClipHeader(count=0, curve='arib-std-b67', primaries='bt2020', deep=True, matrix='')
        >>> header_of("Duration: 00:01:00.50, start: 0\\n Video: h264, yuv420p(progressive), 1280x720, 30 fps")
        ClipHeader(count=1815, curve='', primaries='', deep=False, matrix='bt709')
    """
    line = next(each for each in output.splitlines() if "Video: " in each and "attached pic" not in each)
    hours, minutes, seconds = (re.search(r"Duration: (\d+):(\d+):([\d.]+)", output) or NO_MATCH).groups("0")
    rate = (re.search(r"([\d.]+) fps", line) or NO_MATCH)[1] or 0
    kind, tags, lines = re.search(r", (\w+)(?:\(([^)]*)\))?, \d+x(\d+)", line).groups("")
    named = next((part for part in tags.split(", ") if "/" in part), tags)
    words = re.split(r"[ ,/]+", named)
    matrix = words[:1] if "/" in named else words
    curve = next((word for word in words if word in HDR_CURVES), "")
    return ClipHeader(
        count=round((int(hours) * 3600 + int(minutes) * 60 + float(seconds)) * float(rate)),
        curve=curve,
        primaries=next((word for word in words if word in WIDE_PRIMARIES), "bt2020" if curve else ""),
        deep=bool(re.search(r"(p\d?|gray)(9|1[0246])[lb]e$", kind)),
        matrix="" if any(map(MATRIX, matrix)) else "bt2020nc" if curve else "bt709" if int(lines) >= HD else "bt601",
    )


def watched(path: Path) -> Iterator[Float32[np.ndarray, "h w"]]:
    """Decode a clip's frames in turn, grey ``[H, W]`` of sRGB-like codes in [0, 1], at most ``WATCHED_SIDE`` long.

    A clip that ends too early gives what it has, with a warning.

    Raises:
        DataError: not one frame can be read.
    """
    filters = f"scale=iw*sar:ih,{_at_most(WATCHED_SIDE)},setsar=1,format=gray16be"
    with _running(path, "-vf", filters, "-f", "image2pipe", "-c:v", "pgm", "-") as out:
        while head := out.readline():
            width, height = map(int, out.readline().split())
            out.readline()
            stored = out.read(2 * width * height) if head == b"P5\n" else b""
            if len(stored) < 2 * width * height:
                return
            yield np.frombuffer(stored, ">u2").reshape(height, width).astype(np.float32) / 65535


def write_frames(path: Path, numbers: Sequence[int], folder: Path) -> ClipHeader:
    """Write frames of a clip, numbered from 0, as ``0001.png`` and so on: sRGB, 16 bits where the clip has more than 8.

    HLG and PQ become sRGB with ``HDR_WHITE`` as 1; what is brighter is clipped, what is darker stays in proportion.

    Returns:
        The clip's header.
    """
    header = read_clip(path)
    chosen = "+".join(f"eq(n,{number})" for number in numbers)
    shrunk = f"scale=iw*sar:ih,{_at_most(FRAME_SIDE)},setsar=1"
    filters = [f"select='{chosen}'", *srgb_filters(header), shrunk, "format=rgb48be" if header.deep else "format=rgb24"]
    with _running(path, "-vf", ",".join(filters), "-frames:v", str(len(numbers)), str(folder / "%04d.png")):
        pass
    return header


def srgb_filters(header: ClipHeader) -> list[str]:
    """ffmpeg's filters that turn frames of a clip into sRGB."""
    if not header.primaries:
        return [f"scale=in_color_matrix={header.matrix}:out_color_matrix=bt709"] if header.matrix else []
    stored = f"min={header.matrix}:" if header.matrix else ""
    stored += f"tin={header.curve or 'bt709'}:pin={header.primaries}"
    curve, white = ("iec61966-2-1", HDR_WHITE) if header.curve else ("bt709", 100)
    light, codes = f"{stored}:t=linear:npl={white}", f"p=bt709:t={curve}"  # agamma: the standards' own formulas
    return [f"zscale={light}:agamma=false", "format=gbrpf32le", f"zscale={codes}:agamma=false", "format=gbrp16le"]


def _at_most(side: int) -> str:
    return f"scale=w='min({side},iw)':h='min({side},ih)':force_original_aspect_ratio=decrease:flags=area"


def _ffmpeg(path: Path) -> list[str]:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe
    except ImportError as error:
        raise CTMError(f"reading clips needs ffmpeg: pip install -e '.[photos]' ({error})") from error
    with as_data_error(path, "a clip, but no ffmpeg", "ffmpeg, or no IMAGEIO_FFMPEG_EXE"):
        program = get_ffmpeg_exe()
    return [program, "-hide_banner", "-nostdin", "-y", "-i", f"file:{path}"]


@contextmanager
def _running(path: Path, *arguments: str) -> Iterator[IO[bytes]]:
    """Context with the output of ffmpeg on a clip's frames; a warning where the clip ends too early."""
    program, *given = _ffmpeg(path)
    command = [program, "-v", "error", "-fflags", "+discardcorrupt", *given, "-an", "-sn", "-fps_mode", "passthrough"]
    with tempfile.TemporaryFile() as log:
        process = subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, stderr=log)
        try:
            yield process.stdout
            code = process.wait()
        finally:
            process.kill()
            process.stdout.close()
            process.wait()
        log.seek(0)
        complaints = log.read().decode(errors="replace")
    if code:
        raise DataError(path, f"a clip that cannot be read ({_first(complaints)})", CLIP_EXPECTED)
    if "partial file" in complaints or "Truncated" in complaints:
        warnings.warn(f"{path}: the clip ends too early; what there is of it is used", stacklevel=4)


def _first(complaints: str) -> str:
    """ffmpeg's first error message, the cause of others, without the name of ffmpeg's component."""
    messages = re.findall(r"^\[[^\]]* @ [^\]]*\] (.+)$", complaints, re.M)
    return next((each for each in messages if "low score" not in each), " ".join(complaints.split()[-12:]))
