"""Splats for other programs: their file by the format's description, their colours and their world."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from test_export import parsed

from ctm_plugin.backbones.settings import SplatConfig
from ctm_plugin.backbones.splat import NEAR_FRACTION, Splat
from ctm_plugin.cli import main
from ctm_plugin.color.light import Light
from ctm_plugin.data.llff import LLFFConfig
from ctm_plugin.export.splats import cameras_in_files, in_files, likeness, read_splats, render_splats, write_splats
from ctm_plugin.export.surface import spanned
from ctm_plugin.runs.load import load_posed
from ctm_plugin.splats.gaussians import Gaussians, camera_of, colors_seen


def some(count: int) -> Gaussians:
    """Random ones before a camera that looks along -z."""
    means = torch.randn(count, 3) * 0.5 - torch.tensor([0.0, 0.0, 3.0])
    scales, quats = torch.randn(count, 3) * 0.3 - 2, torch.randn(count, 4)
    opacities, sh0, shN = torch.randn(count, 1), torch.randn(count, 3), 0.2 * torch.randn(count, 45)
    return Gaussians(means, scales, quats, opacities, sh0, shN)


def columns(path: Path) -> dict[str, np.ndarray]:
    """Each property of a file of splats by its name."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    count = int(lines[2].removeprefix("element vertex "))
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert len(lines) == 3 + len(names) + 1
    rows = np.array([struct.unpack_from(f"<{len(names)}f", body, 4 * len(names) * row) for row in range(count)])
    assert len(body) == 4 * len(names) * count
    return dict(zip(names, rows.T, strict=True))


def textbook(of: dict[str, np.ndarray], d: np.ndarray) -> np.ndarray:
    """Colours ``[3, N]`` that are seen along directions ``[3, N]``, as 3DGS has them in ``forward.cu``."""
    x, y, z = d
    basis = [
        -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x,
        1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y),
        -0.5900435899266435 * y * (3 * x * x - y * y), 2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y), 1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    channels = []
    for channel in range(3):
        rest = sum(each * of[f"f_rest_{15 * channel + index}"] for index, each in enumerate(basis))
        channels.append(0.5 + 0.28209479177387814 * of[f"f_dc_{channel}"] + rest)
    return np.maximum(channels, 0)


def test_a_file_is_read_back(tmp_path):
    given = some(50)
    write_splats(tmp_path / "a.ply", given)
    back = read_splats(tmp_path / "a.ply")
    quats = torch.nn.functional.normalize(given.quats, dim=1)
    torch.testing.assert_close(tuple(back), tuple(given._replace(quats=quats)), atol=1e-6, rtol=0)


def test_colours_are_the_format_s(tmp_path):
    """Its harmonics have other signs than ours."""
    given, centre = some(50), torch.tensor([0.3, -0.2, 0.5])
    write_splats(tmp_path / "a.ply", given)
    found = columns(tmp_path / "a.ply")
    directions = torch.nn.functional.normalize(given.means - centre, dim=1).T.double().numpy()
    expected = colors_seen(given, centre, 4, 0.0)
    np.testing.assert_allclose(textbook(found, directions).T, expected, atol=2e-6)
    names = {"means": "xyz", "scales": ("scale_0", "scale_1", "scale_2"), "opacities": ("opacity",)}
    for table, each in names.items():
        np.testing.assert_allclose(np.stack([found[name] for name in each], 1), getattr(given, table), rtol=1e-6)
    assert not any(found[name].any() for name in ("nx", "ny", "nz"))


def test_the_world_is_the_files(hall):
    """A forward-facing scene, moved for NDC: by the files' cameras its Gaussians look as by the scene's own."""
    scene = LLFFConfig(root=hall).load()
    module, views = Splat(SplatConfig(first=80), scene), scene.test
    assert scene.world.scale != 1
    given = some(200)
    given = given._replace(means=given.means * torch.tensor([1.0, 1.0, 2.0]), shN=torch.zeros(200, 0))
    there, cameras = in_files(given, scene), cameras_in_files(module, views)
    plain = LLFFConfig(root=hall, geometry="bounded").load().test
    for index, camera in enumerate(cameras):
        torch.testing.assert_close(camera.centre, plain.c2w[index, :, 3], atol=1e-5, rtol=0)
        ours = camera_of(views, index, NEAR_FRACTION * scene.near)
        want = render_splats(given, ours, torch.ones(3))
        torch.testing.assert_close(render_splats(there, camera, torch.ones(3)), want, atol=1e-3, rtol=0)
        assert want.std() > 0.1
        assert camera.near == pytest.approx(ours.near / scene.world.scale)


def test_normals_of_a_plane():
    """Of neighbours that are not evenly far; where there are none, there is none."""
    across, down = torch.tensor([1.0, 0.2, 0.5]), torch.tensor([0.1, 1.0, -0.3])
    at = torch.rand(5).cumsum(0)[:, None, None] * down + torch.rand(4).cumsum(0)[None, :, None] * across
    normal = torch.nn.functional.normalize(torch.linalg.cross(across, down), dim=0)
    torch.testing.assert_close(spanned(at), normal.expand(5, 4, 3))
    assert (spanned(at[:1, :1]) == 0).all()


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Dark: what is shown is not what is trained on."""
    data = ("dataset=still_life", "dataset.light=dark", "dataset.downscale=4", "ctm=auto")
    sizes = ("backbone=splat", "backbone.steps=200", "backbone.reset_every=0", "trainer=smoke", "logger=none")
    folder = tmp_path_factory.mktemp("splats") / "run"
    assert main([*data, *sizes, "trainer.image_every=null", f"hydra.run.dir={folder}"]) == 0
    return folder


@pytest.mark.slow
def test_lit_splats_from_the_command_line(run, capsys, refused, tmp_path, monkeypatch):
    monkeypatch.setattr("ctm_plugin.export.command.TRAIN_STEPS", 100)
    assert main(["export", str(run)]) == 0
    file, told = run / "export/splats.ply", capsys.readouterr().out
    assert f"written to {file}" in told
    posed = load_posed(run)
    module, found = posed.module, read_splats(file)
    assert posed.light.gain > 2
    away = likeness(module, found, posed.light)
    assert f"{away:.1f} dB" in told
    assert away > 40
    assert likeness(module, found, Light()) < 30
    assert found.means.shape == module.gaussians.means.shape
    torch.testing.assert_close(found.means, module.gaussians.means.detach())

    assert "overwrite=true" in refused("export", run, "what=splats")
    assert main(["export", str(run), "light=off", f"out={tmp_path}"]) == 0
    dark = read_splats(tmp_path / "splats.ply")
    assert likeness(module, dark, Light()) > 50
    assert likeness(module, dark, posed.light) < 30


@pytest.mark.slow
def test_points_of_splats(run, tmp_path):
    """Normals have unit length and face the cameras."""
    command = ["export", str(run), "what=points", f"out={tmp_path}", "opaque=0.1", "light=off"]
    assert main(command) == 0
    vertices, _ = parsed(tmp_path / "points.ply")
    np.testing.assert_allclose(np.linalg.norm(vertices[:, 3:6], axis=1), 1, atol=1e-5)
    centres = load_posed(run).module.c2w[:, :, 3].numpy()
    facing = ((centres[None] - vertices[:, None, :3]) * vertices[:, None, 3:6]).sum(-1)
    assert (facing.max(1) > 0).all()


def test_what_a_run_does_not_have(run, tmp_path, refused):
    told = "found 'mesh', expected points or splats: a mesh needs a run of backbone=dvgo, "
    assert told in refused("export", run, "what=mesh", f"out={tmp_path}")
