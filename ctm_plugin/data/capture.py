"""Contents of a data set's folder: photographs with their cameras, and sources of near and far."""

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
    """A photograph of a data set, with its camera and the files that belong to it.

    Attributes:
        path: the picture's file.
        name: as COLMAP's model or the data set's own file calls it.
        c2w: ``[3, 4]`` camera to world, OpenGL axes.
        camera: intrinsics and lens of its camera.
        picture: the opened file at ``path``; a test view may have none.
        mask: file of a mask, whose bright pixels count; ``None``: all pixels count.
        depth: file of the view's depth, only for test views; all have one or none.
        lit: the same view in normal light, only for test views.
        shown: whether the camera is known to belong to the picture as EXIF turns it.
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
    """The photographs of a data set, and the sources of its near and far bounds.

    Attributes:
        root: the data set's folder.
        source: the file with the cameras, for messages.
        photographs: in the order of the data set.
        testing: ``[N]``, whether a photograph is a test view.
        shrunk: whether the pictures have been shrunk by ``dataset.downscale`` already.
        depth_scale: scene units in one step of the depth.
        records: files that may hold ``near`` and ``far``.
        rows: ``[N, 2]``, nearest and farthest depth in each picture, NaN where that is unknown.
        clouds: functions that find clouds of points, the best cloud first.
        lacking: the file whose points give near and far, and what it lacks if they do not; ``None``: ``source``
            should give both, and a warning says which points do instead.
        synthetic: whether the files are Synthetic-NeRF's, which leave out what the papers' codes know: an object
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
        """A unique name for each photograph, see :func:`~ctm_plugin.data.readers.folders.view_names`."""
        splits = (~self.testing, self.testing) if self.synthetic else (np.ones_like(self.testing),)
        paths = [[self.photographs[i].path for i in np.flatnonzero(split)] for split in splits]
        return tuple(name for split in paths for name in view_names(split))
