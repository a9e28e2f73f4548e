"""The layout of LLFF: ``poses_bounds.npy`` next to ``images``, taken by hand in front of a scene."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64

from ctm_plugin.data.capture import Capture, Photograph
from ctm_plugin.data.load import Layout
from ctm_plugin.data.photographs import every_nth, find_pictures, list_pictures, masks_beside
from ctm_plugin.data.points import model_beside
from ctm_plugin.data.readers.folders import inside, is_picture
from ctm_plugin.data.readers.images import PictureFile, map_numbers, read_picture
from ctm_plugin.data.readers.layouts import LLFF_FILE, model_folder, open_layout
from ctm_plugin.data.readers.lens import Intrinsics
from ctm_plugin.data.readers.records import rendered
from ctm_plugin.data.settings import LLFFSettings
from ctm_plugin.errors import DataError
from ctm_plugin.scene.poses import MAX_COORDINATE, check_rotation


class LLFFConfig(Layout, LLFFSettings):
    layout = "llff"

    def capture(self) -> Capture:
        """Read a data set in LLFF layout.

        Files without bounds, or with zeros or NaN in them, get bounds from the cameras, with a warning. Single rows
        without bounds are left out, and so are those with a far of more than five medians, except under ``forward``.

        Test views have depth where a folder ``depth`` holds it: ``.npy`` in units of the file's poses, or 16-bit PNG
        with ``depth_scale`` in ``settings.json``.

        Forward-facing the scene is moved and scaled, see :func:`~ctm_plugin.data.load.to_ndc_frame`; else it keeps the
        file's units and near lies a little in front of the nearest bound. Far is a distance along the rays that holds
        all that the bounds hold.
        """
        root = open_layout(self.root, self.layout)
        return self.posed(root, *self.developed(root))

    def developed(self, root: Path) -> tuple[list[PictureFile], bool]:
        """The pictures of the folder, and whether they have been shrunk by ``downscale`` already."""
        folder, shrunk = find_pictures(root, self.whole_factor, self.factor)
        return [read_picture(path) for path in list_pictures(root, folder)], shrunk

    def posed(self, root: Path, pictures: list[PictureFile], shrunk: bool) -> Capture:
        """Put pictures, by name, and the rows of ``poses_bounds.npy`` together; DataError: numbers differ."""
        source, paths = inside(root, LLFF_FILE), [picture.path for picture in pictures]
        c2w, hwf, bounds = read_poses(source, bounded=self.near is None or self.far is None)
        if len(paths) != len(c2w):
            expected = f"{len(paths)}, one for each picture in {paths[0].parent}{pictures_hint(root)}"
            raise DataError(source, f"{len(c2w)} poses", expected)
        testing = every_nth(self.test_every, len(paths))
        # LLFF names shrunk pictures anew, in the order of COLMAP's, which images has.
        whole = sorted(path for path in (root / "images").glob("*") if is_picture(path))
        named = [path.name for path in (whole if len(whole) == len(paths) else paths)]
        masks, depths = masks_beside(root, [Path(path.name) for path in paths]), find_depths(root, paths, testing)
        photographs = [
            Photograph(
                picture.path,
                named[row],
                c2w[row],
                Intrinsics(width, height, focal, focal, 0.5 * width, 0.5 * height, where=f"row {row}"),
                picture,
                masks[row],
                depths[row],
            )
            for row, (picture, (height, width, focal)) in enumerate(zip(pictures, hwf.tolist(), strict=True))
        ]
        poses = [(each.name, each.c2w) for each in photographs]
        return Capture(
            root,
            source,
            photographs,
            testing,
            shrunk,
            depth_scale=rendered(root, "depth_scale"),
            rows=bounds,
            clouds=[cache(lambda: model_beside(root, poses))],
        )


def pictures_hint(root: Path) -> str:
    """Word the hint how to find the pictures of the poses in ``poses_bounds.npy``, which does not name them."""
    if (root / "view_imgs.txt").is_file():
        return ": leave only those there that view_imgs.txt names"
    if model := model_folder(root):
        return f": dataset=colmap reads {model.relative_to(root)}, which names those that have one"
    return ": leave only those there that COLMAP placed, which its images.txt or view_imgs.txt names"


def read_poses(
    source: Path, bounded: bool
) -> tuple[Float64[np.ndarray, "n 3 4"], Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 2"] | None]:
    """Read poses: camera to world, OpenGL axes; (height, width, focal length) in pixels; the bounds if ``bounded``.

    Bounds of pictures that see no points, zeros, NaN or infinity in the file, are NaN here; ``None`` where all are.
    Raises a DataError for another shape, NaN in a pose, or numbers that are no camera's.
    """
    expected = "an array [N, 17] of finite numbers: a 3x5 matrix, near and far of each view"
    rows = map_numbers(source, expected)
    if rows.shape[1:] == (3, 5):
        rows = rows.reshape(-1, 15)
    if rows.ndim != 2 or rows.shape[1] not in (15, 17) or not len(rows):
        raise DataError(source, f"an array {list(rows.shape)}", expected)
    rows = np.array(rows, dtype=np.float64)
    if not np.isfinite(rows[:, :15]).all():
        raise DataError(source, "NaN or infinity", expected)
    matrix, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    seen = np.isfinite(bounds).all(1) & bounds.any(1)
    bounds[~seen] = np.nan
    down, right, back, eye, hwf = np.moveaxis(matrix, -1, 0)
    c2w = np.stack([right, -down, back, eye], axis=-1)
    for index, pose in enumerate(c2w):
        check_rotation(pose[:, :3], source, f"row {index}")
        if np.abs(eye[index]).max() > MAX_COORDINATE:
            raise DataError(source, f"row {index} with a camera at {eye[index].tolist()}", f"below {MAX_COORDINATE:g}")
        if not ((hwf[index] > 0) & (hwf[index] <= MAX_COORDINATE)).all():
            found = f"row {index} with height, width, focal length {hwf[index].tolist()}"
            raise DataError(source, found, f"numbers > 0 and at most {MAX_COORDINATE:g}")
    for index in np.flatnonzero(seen) if bounded else ():
        near, far = bounds[index].tolist()
        if not 0 < near < far <= MAX_COORDINATE:
            expected = "0 < near < far, or dataset.near and dataset.far"
            raise DataError(source, f"row {index} with bounds {near:g} and {far:g}", expected)
    return c2w, hwf, bounds if bounded and seen.any() else None


def find_depths(root: Path, pictures: list[Path], testing: Bool[np.ndarray, " n"]) -> list[Path | None]:
    """Find the files of distances along the rays, one for each test view, else a DataError; none without ``depth/``."""
    folder = root / "depth"
    paths: list[Path | None] = [None] * len(pictures)
    for row in np.flatnonzero(testing) if folder.is_dir() else ():
        names = [f"depth/{pictures[row].stem}{suffix}" for suffix in (".npy", ".png")]
        paths[row] = next((path for name in names if (path := inside(root, name)).is_file()), None)
        if paths[row] is None:
            raise DataError(folder / pictures[row].stem, "no depth", "a .npy or .png, or no folder depth at all")
    return paths
