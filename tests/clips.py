"""Clips as phones write them, made by ffmpeg of frames, and a wall to film."""

import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from imageio_ffmpeg import get_ffmpeg_exe
from scipy.ndimage import gaussian_filter

LOSSLESS = ("-c:v", "libx264", "-qp", "0", "-preset", "ultrafast")


def ffmpeg(*arguments: object) -> None:
    subprocess.run([get_ffmpeg_exe(), "-y", "-v", "error", *map(str, arguments)], check=True)


def write_clip(path: Path, frames: Sequence[np.ndarray], *arguments: object, rate: int = 30) -> Path:
    """Frames ``[H, W, 3]`` of 8 or 16 bits, as H.264 without loss unless ``arguments`` say else."""
    kind = "rgb24" if frames[0].dtype == np.uint8 else "rgb48le"
    size = f"{frames[0].shape[1]}x{frames[0].shape[0]}"
    given = ["-f", "rawvideo", "-pix_fmt", kind, "-s", size, "-r", str(rate), "-i", "-"]
    command = [get_ffmpeg_exe(), "-y", "-v", "error", *given, *(map(str, arguments or LOSSLESS)), str(path)]
    subprocess.run(command, input=b"".join(frame.tobytes() for frame in frames), check=True)
    return path


def wall(height: int = 200, width: int = 700) -> np.ndarray:
    """``[H, W, 3]`` bytes with details of all sizes."""
    chance = np.random.default_rng(0)
    codes = sum(gaussian_filter(chance.normal(size=(height, width, 3)), (s, s, 0), mode="wrap") * s for s in (1, 3, 9))
    return np.clip(110 + 110 * codes, 0, 255).astype(np.uint8)


def pan(places: Sequence[float], size: tuple[int, int] = (60, 80), of: np.ndarray | None = None) -> list[np.ndarray]:
    """Frames of a window on a wall, at whole columns."""
    of = wall() if of is None else of
    return [np.ascontiguousarray(of[40 : 40 + size[0], int(at) : int(at) + size[1]]) for at in places]
