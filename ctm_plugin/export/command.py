"""Exports of a run for other programs: splats, points, a mesh, cameras, lit pictures; and a page for people."""

from __future__ import annotations

import shlex
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor

from ctm_plugin.backbones.posed import PosedBackbone
from ctm_plugin.backbones.splat import Splat
from ctm_plugin.color.light import Light, chosen_light
from ctm_plugin.cpu.products import fast_products
from ctm_plugin.data.readers.images import to_8_bits
from ctm_plugin.errors import ConfigError
from ctm_plugin.export.captures import Dots, write_capture
from ctm_plugin.export.page import write_page
from ctm_plugin.export.settings import ExportConfig
from ctm_plugin.export.splats import TRAIN_STEPS, likeness, lit_view, plain, read_splats, write_splats
from ctm_plugin.export.surface import Surface, cloud, mesh
from ctm_plugin.export.video import check_new
from ctm_plugin.files import replacing_folder
from ctm_plugin.runs.load import LoadedRun, load_posed
from ctm_plugin.runs.rundir import ALL, PAGE
from ctm_plugin.scene.poses import IDENTITY
from ctm_plugin.scene.views import Scene, Views, composite
from ctm_plugin.show.bars import tracked
from ctm_plugin.show.console import print_file, print_next
from ctm_plugin.show.pictures import write_png
from ctm_plugin.show.ply import write_ply
from ctm_plugin.splats.gaussians import Gaussians

FOLDER_EXPORTS = ("cameras", "pictures")
"""Exports that are more than one file."""


def export(run: Path, settings: ExportConfig) -> None:
    """Write what a run found for other programs: splats, points, a mesh, cameras or pictures.

    Numbers are in the files' units.

    - ``splats``: the Gaussians as a PLY of 3DGS, in lit RGB. The verb says how close its pictures are to the run's.
    - ``points``: where the training views' rays end, with colours and normals, as a binary PLY.
    - ``mesh``: marching cubes, with colours as seen head-on, of what the training views see up to far; of unbounded
      scenes, of the ball of cameras.
    - ``cameras``: nerfstudio's ``transforms.json`` and COLMAP's ``sparse/0``, with the pictures that it was trained on.
    - ``pictures``: the same folder for programs that train on lit pictures: all training and test views, rendered lit,
      with masks and points. They have the size that the run was trained at: larger ones would show no more. With
      ``photographs=true`` the photographs themselves in that light, in a folder ``photographs``.
    - ``page``: ``index.html``, for a browser: film, test views, and splats to walk through, in one file to be sent.

    Raises:
        CTMError: the folder is no run, its checkpoint cannot be used, it is not of a scene with cameras, there are no
            splats, there is no surface, or files are there already.
    """
    if settings.what == "page":
        place = (Path(settings.out) if settings.out else run) / PAGE
        if not settings.overwrite:
            check_new([place])
        posed = load_posed(run, settings.dataset.root, pictures=False)
        write_page(place, run, posed, chosen_light(settings, posed.light))
        print_file("written to ", place)
        return
    posed = load_posed(run, settings.dataset.root, pictures=settings.photographs)
    module, out = posed.module, Path(settings.out) if settings.out else run / "export"
    light, splats = chosen_light(settings, posed.light), isinstance(module, Splat)
    what = settings.what or ("splats" if splats else "points")
    if what == "splats" and not splats:
        raise ConfigError("what", what, f"points or mesh: a {type(module).__name__} has no Gaussians")
    if what == "mesh" and splats:
        raise ConfigError("what", what, "points or splats: a mesh needs a run of backbone=dvgo, ngp or nerf")
    place = out / ("photographs" if settings.photographs else what if what in FOLDER_EXPORTS else f"{what}.ply")
    if not settings.overwrite:
        there = place.rglob("*") if place.is_dir() else [place]
        check_new(sorted(path for path in there if path.is_file()))
    if what == "splats":
        write_lit(place, module, light)
    elif what == "cameras":
        write_cameras(place, module.scene)
    elif what == "pictures":
        write_pictures(place, module, light, settings)
    else:
        surface, fine = (cloud, settings.points) if what == "points" else (mesh, settings.cells)
        write_surface(place, surface(module, fine, settings.opaque), module.scene, light)
    print(f"written to {place}")
    if what in ("cameras", "pictures"):
        print(f"next: ns-train splatfacto --data {shlex.quote(str(place))}")
    else:
        print_next("view", run)


def write_views(run: Path, posed: LoadedRun) -> None:
    """Write every photograph's view, lit: ``all/NAME.png``."""
    module, scene = posed.module, posed.module.scene
    every = [(views, index) for views in (scene.train, scene.test) for index in range(len(views))]
    with replacing_folder(run / ALL) as folder, fast_products(module.device):
        for views, index in tracked(every, ALL):
            write_png(
                folder / f"{views.names[index]}.png", views.own(index, lit_view(module, views, index, posed.light))
            )


def write_lit(path: Path, module: Splat, light: Light) -> None:
    """Write a run's Gaussians, their colours lit, and tell how close the file is to the run."""
    gaussians = plain(module, light, TRAIN_STEPS)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_splats(path, gaussians)
    back = Gaussians(*(table.to(module.device) for table in read_splats(path)))
    print(f"the test views from this file are {likeness(module, back, light):.1f} dB (PSNR) from the run's pictures")


def write_surface(path: Path, surface: Surface, scene: Scene, light: Light) -> None:
    """Write a surface in the files' world, its colours lit."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_ply(path, *dots_of(surface, scene, light), None if surface.faces is None else surface.faces.numpy())


def dots_of(surface: Surface, scene: Scene, light: Light) -> Dots:
    """A surface's points in the files' world, their colours lit."""
    back = (scene.world or IDENTITY).inverse()
    points, normals = back.moved(surface.points.double().numpy()), surface.normals.double().numpy() @ back.turn.T
    return Dots(points, normals, to_8_bits(light.apply(surface.colors)).numpy())


def write_cameras(folder: Path, scene: Scene) -> None:
    """Write a scene's views as they were trained on; views without a picture are listed all the same."""

    def as_captured(views: Views, index: int) -> Tensor | None:
        return views.images[index] if views.pictured is None or views.pictured[index] else None

    write_capture(folder, scene, as_captured, absent=True)


def write_pictures(folder: Path, module: PosedBackbone, light: Light, settings: ExportConfig) -> None:
    """Write a scene's views lit, rendered or as photographed, with its reconstruction's points, else the run's own."""
    scene, behind = module.scene, module.constant_background().cpu()

    def rendered(views: Views, index: int) -> UInt8[Tensor, "h w 3"]:
        return to_8_bits(lit_view(module, views, index, light).cpu())

    def photographed(views: Views, index: int) -> UInt8[Tensor, "h w 3"] | None:
        there = views.pictured is None or views.pictured[index]
        return to_8_bits(light.apply(composite(views.images[index], behind))) if there else None

    with fast_products(module.device):
        tracks = scene.points is not None and len(scene.points.point)
        dots = None if tracks else dots_of(cloud(module, settings.points, settings.opaque), scene, light)
        write_capture(folder, scene, photographed if settings.photographs else rendered, dots)
