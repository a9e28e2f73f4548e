"""Contents of a folder of photographs by its files: cameras, pictures, and sources of near and far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from ctm_plugin.data.points import PointsOrReason
from ctm_plugin.data.readers.folders import view_names
from ctm_plugin.data.readers.images import PictureFile
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.data.readers.records import Record


@dataclass(frozen=True)
class Photograph:
    """A picture and how it was taken.

    Attributes:
        path: the picture's file.
        name: as COLMAP's model or the data set's own file calls it.
        c2w: ``[3, 4]`` camera to world, OpenGL axes.
        camera: what took it.
        picture: that file; of a test view it need not be there.
        mask: the picture of which pixels count, bright ones do; ``None``: all.
        depth: the file of its depth, only for test views; all have one or none.
        lit: the same view in normal light, only for test views.
        shown: whether the camera is known to be of the picture as EXIF turns it.
    """

    path: Path
    name: str
    c2w: Float64[np.ndarray, "3 4"]
    camera: Intrinsics
    picture: PictureFile | None
    mask: Path | None = None
    depth: Path | None = None
    lit: PictureFile | None = None
    shown: bool = False


@dataclass(frozen=True)
class Capture:
    """The photographs of a data set, and what its files say of near and far.

    Attributes:
        root: the data set's folder.
        source: the file with the cameras, for messages.
        photographs: in the order of the data set.
        testing: ``[N]``, whether one is for testing.
        shrunk: whether the pictures have been shrunk by ``dataset.downscale`` already.
        depth_scale: scene units in one step of the depth.
        records: files that may hold ``near`` and ``far``.
        rows: ``[N, 2]``, the depths between which each picture sees something, NaN where nobody tells.
        clouds: find points, the best first.
        lacking: the file whose points tell near and far, and what it lacks where they do not; ``None``: ``source``
            should tell both, and a warning says whose points do.
        synthetic: whether they are Synthetic-NeRF's kind, whose files leave out what the paper's codes know: a thing
            with nothing behind it, near and far of all its scenes where they suit, views named within their split.
    """

    root: Path
    source: Path
    photographs: Sequence[Photograph]
    testing: Bool[np.ndarray, " n"]
    shrunk: bool = False
    depth_scale: float = 1.0
    records: Sequence[Record] = ()
    rows: Float64[np.ndarray, "n 2"] | None = None
    clouds: Sequence[Callable[[], PointsOrReason]] = ()
    lacking: tuple[Path, str] | None = None
    synthetic: bool = False

    @property
    def c2w(self) -> Float64[np.ndarray, "n 3 4"]:
        return np.stack([each.c2w for each in self.photographs])

    @property
    def views(self) -> tuple[str, ...]:
        """A unique name for each view, see :func:`~ctm_plugin.data.readers.folders.view_names`."""
        splits = (~self.testing, self.testing) if self.synthetic else (np.ones_like(self.testing),)
        paths = [[self.photographs[i].path for i in np.flatnonzero(split)] for split in splits]
        return tuple(name for split in paths for name in view_names(split))
