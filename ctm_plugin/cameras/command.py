"""Cameras of photographs, into the folder where they lie."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import torch
import torch.nn.functional as F
from jaxtyping import Float32
from torch import Tensor

from ctm_plugin.cameras.clips import take_frames
from ctm_plugin.cameras.colmap import FEWEST, Reconstruction, Workshop, choose_pairs, extract, require_pycolmap
from ctm_plugin.cameras.photographs import home_of, list_photographs, of_one_size
from ctm_plugin.cameras.raws import develop_raws
from ctm_plugin.cameras.settings import CamerasConfig
from ctm_plugin.color.light import brighten, factor_to_mean
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.data.readers.colmap_model import mark_as_shown
from ctm_plugin.data.readers.folders import require_folder
from ctm_plugin.data.readers.images import Picture
from ctm_plugin.errors import DataError
from ctm_plugin.files import replacing_folder
from ctm_plugin.show.bars import bar
from ctm_plugin.show.console import output_console, print_next, table_for

T = TypeVar("T")
MODEL = Path("sparse", "0")
SHARPER = "sharper pictures with more light, which overlap more"
TOLD = 5
"""Names of pictures in a message, at most."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of linear sRGB's primaries (IEC 61966-2-1)."""
THIN = 8
"""One of so many rows and columns says how bright a picture is."""


def cameras(folder: Path, settings: CamerasConfig) -> None:
    """Find where photographs were taken from, with COLMAP on brightened copies, and write ``sparse/0`` next to them.

    FOLDER has the photographs in ``images``, of one size and one lens. They stay as they are; ``dataset=colmap`` reads
    the folder afterwards. It may be a clip, or hold some, see :func:`~ctm_plugin.cameras.clips.take_frames`.
    """
    root = take_frames(folder, settings.pictures)
    develop_raws(root)
    tell(root, *place(root, settings))
    print_next("photos", root)


def place(folder: Path, settings: CamerasConfig) -> tuple[list[str], Reconstruction, float]:
    """Find the cameras and write them, see :func:`cameras`.

    Returns:
        The photographs' names, COLMAP's model, and the factor on their light that it was found with.
    """
    root = require_folder(folder, f"a folder with photographs in {settings.pictures}")
    paths = list_photographs(root, settings.pictures)
    pictures, home = of_one_size(paths), home_of(root, settings.pictures)
    names = [path.relative_to(home).as_posix() for path in paths]
    for there in (root / MODEL, root / MODEL.parent / "cameras.bin"):
        if not settings.overwrite and (there.exists() or there.is_symlink()):
            raise DataError(there, "cameras that are there already", "none, or overwrite=true to replace them")
    require_pycolmap()
    try:
        with replacing_folder(root / MODEL) as target:
            model, gain = find_cameras(pictures, names, settings)
            model.extract_colors_for_all_images(home)
            model.write_binary(target)
            mark_as_shown(target)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("stopped; nothing was written") from None
    except PermissionError as error:
        found = f"a folder that cannot be written to ({error.strerror})"
        raise DataError(root, found, "a copy of it: cameras are written next to the photographs") from error
    return names, model, gain


def find_cameras(
    pictures: Sequence[Picture], names: Sequence[str], settings: CamerasConfig
) -> tuple[Reconstruction, float]:
    """COLMAP's model of pictures of these names, and the factor on their light that it was found with."""
    paths, (height, width, *_) = [each.path for each in pictures], pictures[0].header
    factor = -(-max(height, width) // settings.size)
    gain = 1.0
    with tempfile.TemporaryDirectory(prefix="ctm_cameras_") as scratch:
        work = Workshop(Path(scratch), settings.threads, settings.seed)
        with ThreadPoolExecutor(None if settings.threads < 0 else settings.threads) as pool:
            if settings.brighten:
                thin = pool.map(lambda each: read_grey(each, factor)[::THIN, ::THIN], pictures)
                gain = find_gain(list(shown("brightness", thin, paths)))
            found = pool.map(lambda each: extract(brighten(read_grey(each, factor), gain).numpy(), factor), pictures)
            features = list(shown("details", found, paths))
        work.store(paths[0], (height, width), settings.lens, features)
        pairs = choose_pairs(len(paths), settings.all_pairs)
        with bar("pairs", len(pairs)) as done:
            matched = work.match(pairs, done)
        with bar("placed", len(paths)) as done:
            model = work.reconstruct(names, done)
    placed = 0 if model is None else model.num_reg_images()
    if placed < FEWEST:
        mean = sum(len(each.places) for each in features) / len(paths)
        told = f"a place for {placed} of {len(paths)} pictures ({mean:.0f} details in a mean picture; "
        told += f"{matched} of {len(pairs)} pairs match)"
        more = "" if settings.brighten else "brighten=true; "
        wanted = f"for {FEWEST} at least: {more}"
        alike = matched == len(pairs) and not placed
        wanted += "pictures from different places: these all look alike" if alike else SHARPER
        raise DataError(paths[0].parent, told, wanted)
    return model, gain


def read_grey(picture: Picture, factor: int) -> Float32[Tensor, "h w"]:
    """A picture's luminance ``[H // factor, W // factor]``, averaged as light, as sRGB in [0, 1]; a rest is cut."""
    light = srgb_to_linear(picture.image()[..., :3]) @ torch.tensor(LUMINANCE)
    return linear_to_srgb(F.avg_pool2d(light[None, None], factor)[0, 0].clamp(0, 1))


def find_gain(greys: Sequence[Float32[Tensor, "h w"]]) -> float:
    """Find the factor >= 1 on light that brings pictures ``[h, w]``, sRGB in [0, 1], together to a usual one's mean."""
    levels = torch.cat([grey.flatten() for grey in greys])
    return factor_to_mean(levels, torch.ones_like(levels))


def tell(root: Path, names: Sequence[str], model: Reconstruction, gain: float) -> None:
    """Print what was found, where it is and how to go on."""
    placed = {image.name for image in model.images.values()}
    (camera,) = model.cameras.values()
    console = output_console()
    table = table_for(console, show_header=False)
    table.add_row("pictures", f"{len(placed)} of {len(names)}")
    table.add_row("points", f"{model.num_points3D()}")
    table.add_row("reprojection error", f"{model.compute_mean_reprojection_error():.2f} pixels (mean)")
    table.add_row("focal length", f"{camera.mean_focal_length():.1f} pixels of {camera.width}x{camera.height}")
    table.add_row("brightened", f"{gain:.1f} times" if gain > 1 else "not at all")
    console.print(table)
    if left := [name for name in names if name not in placed]:
        told = ", ".join(left[:TOLD]) + ", ..." * (len(left) > TOLD)
        console.print(f"not placed, and not trained on: {told}", soft_wrap=True, highlight=False, markup=False)
    console.print(f"written to {root / MODEL}", soft_wrap=True, highlight=False, markup=False)


def shown(what: str, results: Iterable[T], paths: Sequence[Path]) -> Iterator[T]:
    """Results of pictures, with a bar on how many there are."""
    with bar(what, len(paths)) as done:
        for number, (result, path) in enumerate(zip(results, paths, strict=True), 1):
            done(number, path.name)
            yield result
