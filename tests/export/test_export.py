"""Points, meshes and cameras of runs, for other programs."""

import json
import math
import struct
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering
from ctm_plugin.backbones.settings import DVGOConfig, NeRFConfig, NGPConfig
from ctm_plugin.cli import main
from ctm_plugin.color.light import Light
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import CTMError
from ctm_plugin.export.command import write_cameras, write_surface
from ctm_plugin.export.surface import LAYER_THICKNESS, Surface, cloud, mesh
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.scene.views import Scene

RADIUS, CENTRE = 0.8, (0.1, -0.05, 0.0)
BOX = [[-1.2, -1.1, -1.0], [1.2, 1.1, 1.0]]
LAYER = 2.4 * LAYER_THICKNESS
COLOUR = (0.3, 0.1, 0.02)


class Ball(RadianceBackbone):
    """A ball of one colour, whose renderings are worked out; half the light stops in ``LAYER`` of what is at RADIUS."""

    def query(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        inside = RADIUS - (points - torch.tensor(CENTRE)).norm(dim=1)
        return 2 * math.log(2) / LAYER * torch.sigmoid(40 * inside), torch.tensor(COLOUR).expand_as(points)

    def render(self, rays: Rays, background: Tensor, draws: object) -> RayRendering:
        to = torch.tensor(CENTRE) - rays.origins
        along = (to * rays.directions).sum(1)
        inner = RADIUS**2 - to.square().sum(1) + along.square()
        hit = inner > 0
        latent = torch.where(hit[:, None], torch.tensor(COLOUR), background)
        depth = torch.where(hit, along - inner.clamp_min(0).sqrt(), self.scene.far)
        return RayRendering((latent,), opacity=hit.float(), depth=depth)


@pytest.fixture(scope="module")
def scene(ball) -> Scene:
    return BlenderConfig(root=ball).load()


@pytest.fixture(scope="module")
def sphere(scene) -> Ball:
    return Ball(scene, 8)


@pytest.fixture(scope="module")
def meshed(sphere) -> Surface:
    sphere.world_box = lambda: torch.tensor(BOX)
    return mesh(sphere, 40, 0.5)


def from_centre(surface: Surface) -> tuple[Tensor, Tensor]:
    offset = surface.points - torch.tensor(CENTRE)
    return offset.norm(dim=1), torch.nn.functional.normalize(offset, dim=1)


def test_a_ball_s_mesh(meshed):
    """Its radius, normals outwards, faces that turn with them, its volume, its colour."""
    distance, out = from_centre(meshed)
    cell = 2.4 / 40
    assert (distance - RADIUS).abs().max() < 0.2 * cell
    assert (meshed.normals * out).sum(1).min() > 0.98
    a, b, c = meshed.points[meshed.faces.long()].unbind(1)
    volume = (torch.linalg.cross(a, b) * c).sum() / 6
    assert volume.item() == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.02)
    torch.testing.assert_close(meshed.colors, torch.tensor(COLOUR).expand_as(meshed.colors))


def test_a_ball_s_points(sphere):
    found = cloud(sphere, 10_000, 0.5)
    distance, out = from_centre(found)
    assert len(found.points) > 100
    assert (distance - RADIUS).abs().max() < 1e-3
    assert (found.normals * out).sum(1).min() > 0.99
    assert len(cloud(sphere, len(found.points), 0.5).points) < len(found.points)


def test_nothing_there(sphere, scene):
    sphere_of_air = Ball(scene, 8)
    sphere_of_air.query = lambda points, directions: (torch.zeros(len(points)), points)
    with pytest.raises(CTMError, match=r"no surface at opaque=0\.5: .* a lower one finds some"):
        mesh(sphere_of_air, 8, 0.5)
    with pytest.raises(CTMError, match="RadianceBackbone has no method query"):
        RadianceBackbone(scene, 8).query(torch.zeros(1, 3), torch.zeros(1, 3))


def parsed(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices' nine numbers and faces' three, by the format's description."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    counts = {line.split()[1]: int(line.split()[2]) for line in lines if line.startswith("element")}
    vertices = [struct.unpack_from("<6f3B", body, 27 * index) for index in range(counts["vertex"])]
    rest = body[27 * counts["vertex"] :]
    faces = [struct.unpack_from("<B3i", rest, 13 * index) for index in range(counts.get("face", 0))]
    assert len(rest) == 13 * len(faces)
    assert all(face[0] == 3 for face in faces)
    return np.array(vertices), np.array([face[1:] for face in faces])


def test_files_and_their_light(meshed, scene, tmp_path):
    for name, light in (("dark", Light()), ("lit", Light(8.0, 1.2, 1.1))):
        write_surface(tmp_path / f"{name}.ply", meshed, scene, light)
    (vertices, faces), (lit, _) = (parsed(tmp_path / f"{name}.ply") for name in ("dark", "lit"))
    np.testing.assert_allclose(vertices[:, :3], meshed.points, rtol=1e-6)
    np.testing.assert_allclose(vertices[:, 3:6], meshed.normals, atol=1e-6)
    assert (faces == meshed.faces.numpy()).all()
    assert (vertices[:, 6:] == np.round(255 * np.array(COLOUR))).all()
    expected = Light(8.0, 1.2, 1.1).apply(torch.tensor(COLOUR)) * 255
    assert np.abs(lit[:, 6:] - expected.numpy()).max() <= 0.5 + 1e-3


# The seam: what backbones say of points is what they render.


def backbone(kind: str, scene: Scene) -> RadianceBackbone:
    if kind == "dvgo":
        small = {"voxels": 4000, "planes": 16, "rays": 8, "coarse": False, "grow": (), "step_size": 0.1}
        module = DVGO(DVGOConfig(geometry=scene.geometry, threshold=1e-7, **small), scene)
        torch.nn.init.normal_(module.field.density, std=1.5)
        torch.nn.init.normal_(module.field.features)
    elif kind == "ngp":
        small = {"levels": 2, "log2_entries": 10, "coarsest": 4, "finest": 8, "width": 16, "cells": 512, "rays": 8}
        module = NGP(NGPConfig(geometry=scene.geometry, samples=2000, threshold=1e-7, **small), scene)
        torch.nn.init.uniform_(module.field.hash_grid.table, -1, 1)
    else:
        module = NeRF(NeRFConfig(geometry=scene.geometry, width=16, depth=3, skip=2, rays=8), scene)
    return module.eval()


@pytest.fixture(scope="module")
def scenes(ball, hall) -> dict[str, Scene]:
    return {
        "bounded": BlenderConfig(root=ball).load(),
        "unbounded": BlenderConfig(root=ball, geometry="unbounded").load(),
        "forward": LLFFConfig(root=hall).load(),
    }


@pytest.mark.parametrize(
    ("kind", "geometry"),
    [("dvgo", "bounded"), ("dvgo", "forward"), ("ngp", "bounded"), ("ngp", "forward"), ("ngp", "unbounded")],
)
@torch.no_grad()
def test_density_along_rays_is_what_is_rendered(scenes, kind, geometry):
    """Its integral, by the midpoint rule in the world, against the rendering's opacity."""
    torch.manual_seed(0)
    scene = scenes[geometry]
    module = backbone(kind, scene)
    rays = module.training_rays(torch.randint(len(module.pixels), (30,)))
    rendered = module.render_rays(rays)
    # From the near plane (in the world of NDC: where z = -1), evenly in inverse distance, which suits all geometries.
    start = torch.full((30,), scene.near)
    if geometry == "forward":
        start = (-1 - rays.origins[:, 2]) / rays.directions[:, 2]
    inverse = torch.linspace(1, scene.near / scene.far if geometry == "bounded" else 1e-4, 4001)
    ends = start[:, None] / inverse
    middles, lengths = (ends[:, 1:] + ends[:, :-1]) / 2, ends.diff(dim=1)
    points = rays.origins[:, None] + middles[..., None] * rays.directions[:, None]
    directions = rays.directions[:, None].expand_as(points).reshape(-1, 3)
    density = module.query(points.reshape(-1, 3), directions)[0].view_as(lengths)
    if geometry == "forward":  # a unit of depth, not of length
        lengths = lengths * -rays.directions[:, 2:]
    expected = -torch.expm1(-(density * lengths).sum(1))
    torch.testing.assert_close(rendered.opacity, expected, atol=0.02, rtol=0.02)
    assert 0.1 < expected.mean() < 0.999
    assert expected.std() > 0.003


@pytest.mark.parametrize("kind", ["dvgo", "ngp"])
@torch.no_grad()
def test_colours_at_samples_are_those_of_the_rendering(scenes, kind):
    module = backbone(kind, scenes["bounded"])
    rays = module.training_rays(torch.arange(30))
    samples = module.render(rays, torch.zeros(1, 3), None).samples
    points, directions = rays.points(samples.t, samples.ray_index), rays.directions[samples.ray_index]
    torch.testing.assert_close(module.query(points, directions)[1], samples.latent, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("geometry", ["bounded", "unbounded", "forward"])
@torch.no_grad()
def test_nerf_s_density(scenes, geometry):
    """Of a field of constant density 1: in NDC it is the length of the line there that a unit of depth becomes."""
    module = backbone("nerf", scenes[geometry])
    module.fine.forward = lambda points, directions: (torch.ones(points.shape[:2]), points)
    depth = torch.linspace(1.5, 9.0, 20, dtype=torch.float64)
    line = torch.tensor([0.1, -0.2, -1.0], dtype=torch.float64)
    density, _ = module.query(depth[:, None] * line, line.expand(20, 3))
    if geometry != "forward":
        assert (density == 1).all()
        return
    step = 1e-4
    there, then = (module.space.place((depth + off)[:, None] * line)[0] for off in (-step, step))
    torch.testing.assert_close(density, (then - there).norm(dim=1) / (2 * step), rtol=1e-5, atol=0)


# Cameras.


def test_cameras_load_back(hall, tmp_path):
    """A forward-facing scene, moved for NDC: its cameras as the files had them, and the same scene out of them."""
    scene = LLFFConfig(root=hall).load()
    write_cameras(tmp_path / "out", scene)
    content = json.loads((tmp_path / "out/transforms.json").read_text())
    frames = content["frames"]
    # Nerfstudio scores the validation pictures while it trains, and refuses a file that lists others without them.
    assert content["val_filenames"] == content["test_filenames"]
    there = {Path(frame["file_path"]).stem: frame["transform_matrix"] for frame in frames}
    plain = LLFFConfig(root=hall, geometry="bounded").load()
    for views in (plain.train, plain.test):
        ours = torch.tensor([there[name][:3] for name in views.names])
        torch.testing.assert_close(ours, views.c2w, atol=1e-5, rtol=1e-5)
    back = TransformsConfig(root=tmp_path / "out", geometry="forward").load()
    assert (back.near, back.far) == pytest.approx((scene.near, scene.far), rel=1e-5)
    assert (back.train.names, back.test.names) == (scene.train.names, scene.test.names)
    for one, two in ((back.train, scene.train), (back.test, scene.test)):
        assert torch.equal(one.images, two.images)
        pixel = torch.arange(len(one) * one.height * one.width)
        found, wanted = (pixel_rays(v.c2w, v.intrinsics, v.height, v.width, pixel) for v in (one, two))
        torch.testing.assert_close(tuple(found), tuple(wanted), atol=1e-5, rtol=1e-5)


def test_lenses_masks_and_deep_pictures_load_back(scene, tmp_path):
    def spoilt(views):
        mask = torch.ones(views.images.shape[:3], dtype=torch.bool)
        mask[:, 3:5] = False
        lens = torch.tensor([[-0.05, 0.01, 0.001, -0.002, 0.003]]).repeat(len(views), 1)
        return replace(views, images=views.images[..., :3] / 300.0, mask=mask, distortion=lens, depth=None)

    given = replace(scene, train=spoilt(scene.train), test=spoilt(scene.test))
    write_cameras(tmp_path, given)
    back = TransformsConfig(root=tmp_path).load()
    assert (back.near, back.far, back.world) == (given.near, given.far, None)
    for one, two in ((back.train, given.train), (back.test, given.test)):
        torch.testing.assert_close(one.images, two.images, atol=0.5 / 65535 + 1e-6, rtol=0)
        assert torch.equal(one.mask, two.mask)
        torch.testing.assert_close(one.distortion, two.distortion)


SIZES = ("trainer=smoke", "backbone.steps_alone=3", "backbone.coarse=false", "backbone.grow=[]", "ctm=off")


@pytest.fixture(scope="module")
def run(ball, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("exports") / "run"
    data = ("dataset=blender", f"dataset.root={ball}", "dataset.exposure=0.05")
    assert main([*data, *SIZES, f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.mark.parametrize("what", ["points", "mesh"])
def test_from_the_command_line(run, capsys, what):
    command = ["export", str(run), f"what={what}", "opaque=1e-6", "cells=12"]
    assert main(command) == 0
    assert capsys.readouterr().out.endswith(f"written to {run / f'export/{what}.ply'}\nnext: ctm view {run}\n")
    lit = parsed(run / f"export/{what}.ply")[0]
    assert main([*command, "light=off", "overwrite=true"]) == 0
    dark = parsed(run / f"export/{what}.ply")[0]
    assert lit[:, 6:].mean() > dark[:, 6:].mean() + 5
    assert main(command) != 0
    assert "overwrite=true" in capsys.readouterr().err


@pytest.fixture(scope="module")
def pictured(run, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("pictures")
    assert main(["export", str(run), "what=pictures", "opaque=1e-6", f"out={out}"]) == 0
    return out / "pictures"


def test_lit_pictures(run, pictured):
    """Of all views, those for testing as the run showed them."""
    assert len(list((pictured / "images").iterdir())) == 10
    for index in range(2):
        one, other = (
            iio.imread(path) for path in (pictured / f"images/test_r_{index}.png", run / f"lit/r_{index}.png")
        )
        assert (one == other).all()
    assert (pictured / "sparse_pc.ply").is_file()


def test_photographs_in_the_same_light(run, tmp_path, capsys, refused):
    command = ["export", str(run), "photographs=true", f"out={tmp_path}", "opaque=1e-6"]
    assert "photographs: found True, expected false, or what=pictures" in refused(*command)
    assert main([*command, "what=pictures"]) == 0
    assert capsys.readouterr().out.endswith(f"next: ns-train splatfacto --data {tmp_path / 'photographs'}\n")
    for index in range(2):
        paths = (tmp_path / f"photographs/images/test_r_{index}.png", run / f"photo/r_{index}.png")
        one, other = map(iio.imread, paths)
        assert (one == other).all()


@pytest.mark.parametrize("layout", ["transforms", "colmap"])
def test_lit_pictures_are_trained_on(pictured, tmp_path, layout):
    data = (f"dataset={layout}", f"dataset.root={pictured}", "backbone=dvgo", "dataset.geometry=bounded")
    assert main([*data, *SIZES, "logger=none", f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    scores = json.loads((tmp_path / "run/metrics.json").read_text())
    assert scores["light_factor"] == 1


@pytest.mark.parametrize(("what", "left"), [("pictures", "images/a.png"), ("cameras", "images/a.png")])
def test_files_of_an_export_that_was_not_finished_stay(run, tmp_path, capsys, what, left):
    file = tmp_path / what / left
    file.parent.mkdir(parents=True)
    file.touch()
    assert main(["export", str(run), f"what={what}", f"out={tmp_path}"]) == 1
    assert f"out: found '{file}', expected a file that is not there yet" in capsys.readouterr().err
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [file]


def test_what_a_run_does_not_have(run, tmp_path, capsys, refused):
    assert main(["export", str(run), "what=splats", f"out={tmp_path / 'out'}"]) == 1
    assert "what: found 'splats', expected points or mesh: a DVGO has no Gaussians" in capsys.readouterr().err
    assert "expected a run directory" in refused("export", tmp_path)
    assert list(tmp_path.iterdir()) == []
