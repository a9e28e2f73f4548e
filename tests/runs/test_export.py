"""Points and cameras of runs, for other programs."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from torch import Tensor

from ctm_plugin.backbones.radiance import RadianceBackbone, RayRendering
from ctm_plugin.cli import main
from ctm_plugin.color.light import Light
from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.rays.cameras import Rays, pixel_rays
from ctm_plugin.runs.export import write_cameras, write_surface
from ctm_plugin.runs.surface import Surface, cloud
from ctm_plugin.scene.views import Scene

RADIUS, CENTRE = 0.8, (0.1, -0.05, 0.0)
COLOUR = (0.3, 0.1, 0.02)


class Ball(RadianceBackbone):
    """A ball of one colour, whose renderings are worked out."""

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


def from_centre(surface: Surface) -> tuple[Tensor, Tensor]:
    offset = surface.points - torch.tensor(CENTRE)
    return offset.norm(dim=1), torch.nn.functional.normalize(offset, dim=1)


def test_a_ball_s_points(sphere):
    found = cloud(sphere, 10_000, 0.5)
    distance, out = from_centre(found)
    assert len(found.points) > 100
    assert (distance - RADIUS).abs().max() < 1e-3
    assert (found.normals * out).sum(1).min() > 0.99
    assert len(cloud(sphere, len(found.points), 0.5).points) < len(found.points)


def parsed(path: Path) -> np.ndarray:
    """Vertices' nine numbers, by the format's description."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    (count,) = (int(line.split()[2]) for line in lines if line.startswith("element"))
    assert len(body) == 27 * count
    return np.array([struct.unpack_from("<6f3B", body, 27 * index) for index in range(count)])


def test_files_and_their_light(sphere, scene, tmp_path):
    found = cloud(sphere, 10_000, 0.5)
    for name, light in (("dark", Light()), ("lit", Light(8.0, 1.2, 1.1))):
        write_surface(tmp_path / f"{name}.ply", found, scene, light)
    vertices, lit = (parsed(tmp_path / f"{name}.ply") for name in ("dark", "lit"))
    np.testing.assert_allclose(vertices[:, :3], found.points, rtol=1e-6)
    np.testing.assert_allclose(vertices[:, 3:6], found.normals, atol=1e-6)
    assert (vertices[:, 6:] == np.round(255 * np.array(COLOUR))).all()
    expected = Light(8.0, 1.2, 1.1).apply(torch.tensor(COLOUR)) * 255
    assert np.abs(lit[:, 6:] - expected.numpy()).max() <= 0.5 + 1e-3


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


def test_from_the_command_line(run, capsys):
    command = ["export", str(run), "what=points", "opaque=1e-6"]
    assert main(command) == 0
    assert capsys.readouterr().out.endswith(f"written to {run / 'export/points.ply'}\nnext: ctm view {run}\n")
    lit = parsed(run / "export/points.ply")
    assert main([*command, "light=off", "overwrite=true"]) == 0
    dark = parsed(run / "export/points.ply")
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
    assert "what: found 'splats', expected points: a DVGO has no Gaussians" in capsys.readouterr().err
    assert "expected a run directory" in refused("export", tmp_path)
    assert list(tmp_path.iterdir()) == []
