"""Rays of a scene with lenses: the same in training and in rendering, and undistorted."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from ctm_plugin.assemble import assemble
from ctm_plugin.data.scene import Scene
from ctm_plugin.rays.cameras import pixel_rays
from ctm_plugin.scenes.trajectory import hemisphere
from ctm_plugin.train import train

WIDTH, HEIGHT = 12, 8


@pytest.fixture
def wide(tmp_path):
    """A data set in nerfstudio's layout, taken with a wide-angle lens."""
    (tmp_path / "images").mkdir()
    content = {"camera_model": "OPENCV", "fl_x": 10.0, "cx": 5.5, "k1": -0.2, "k2": 0.03, "near": 2, "far": 6}
    content["frames"] = []
    for index, pose in enumerate(hemisphere(9, 4.0, seed=1)):
        name = f"images/{index}.png"
        iio.imwrite(tmp_path / name, np.full((HEIGHT, WIDTH, 3), 20 * index, dtype=np.uint8))
        content["frames"].append({"file_path": name, "transform_matrix": pose.tolist()})
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path


def rays_of(scene: Scene, split: str, distortion) -> torch.Tensor:
    views = getattr(scene, split)
    pixel = torch.arange(len(views) * HEIGHT * WIDTH)
    return pixel_rays(views.c2w, views.intrinsics, HEIGHT, WIDTH, pixel, distortion).directions


def test_training_and_rendering_see_through_the_lens(wide, compose, monkeypatch):
    module = assemble(compose("dataset=transforms", f"dataset.root={wide}", "trainer=smoke")).backbone
    scene, seen = module.scene, []
    render_rays = module.render_rays
    monkeypatch.setattr(module, "render_rays", lambda rays: seen.append(rays.directions) or render_rays(rays))
    for index in range(len(scene.test)):
        module.render_view(scene.test, index)
    for directions, split in (
        (module.training_rays(torch.arange(len(module.pixels))).directions, "train"),
        (torch.cat(seen), "test"),
    ):
        torch.testing.assert_close(directions, rays_of(scene, split, getattr(scene, split).distortion))
        assert (directions - rays_of(scene, split, None)).abs().max() > 0.01


def test_a_run_with_a_lens(wide, compose, tmp_path, offline):
    config = compose("dataset=transforms", f"dataset.root={wide}", "trainer=smoke", "ctm=off")
    assert train(config, tmp_path / "run")["psnr"] > 0
