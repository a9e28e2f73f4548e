"""Photographs as the browser's camera sees them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ctm_plugin.color.light import brighten
from ctm_plugin.scene.views import Views
from ctm_plugin.view.camera import Camera, view_camera
from ctm_plugin.view.look import Shot
from ctm_plugin.view.photograph import Photograph

HEIGHT, WIDTH = 24, 32


def photograph(distortion: torch.Tensor | None = None) -> Photograph:
    """A picture that is smooth: x in red, y in green."""
    y, x = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    image = torch.stack([x / WIDTH, y / HEIGHT, torch.full_like(x, 0.5)], dim=-1)[None]
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    c2w = torch.from_numpy(np.column_stack([turn, [1.0, 2.0, 3.0]])).float()[None]
    lens = torch.tensor([[30.0, 30.0, WIDTH / 2, HEIGHT / 2]])
    return Photograph("a view", Views(image, c2w, lens, ("a view",), distortion=distortion), 0, torch.zeros(1, 3))


def seen(of: Photograph, camera: Camera, height: int = HEIGHT, width: int = WIDTH) -> torch.Tensor:
    return of.render(Shot(camera), height, width, lambda: True)["rgb"]


def test_from_its_own_camera_it_is_itself():
    of = photograph()
    picture = seen(of, view_camera(of.views, 0))
    torch.testing.assert_close(picture, of.views.images[0], atol=1e-4, rtol=0)


def test_a_wider_window_has_black_beside_it():
    of = photograph()
    camera = view_camera(of.views, 0)
    picture = seen(of, replace(camera, aspect=2 * camera.aspect), HEIGHT, 2 * WIDTH)
    torch.testing.assert_close(picture[:, WIDTH // 2 : -WIDTH // 2], of.views.images[0], atol=1e-4, rtol=0)
    assert not picture[:, : WIDTH // 2 - 1].any()


def test_it_turns_with_the_camera():
    """Turned to the right by a pixel's angle, the middle shows what was a pixel to the right of it."""
    of = photograph()
    camera = view_camera(of.views, 0)
    c2w = of.views.c2w[0].double().numpy()
    turn = Rotation.from_rotvec(-np.arctan(1 / 30) * c2w[:, 1]).as_matrix()
    turned = Camera.of(np.column_stack([turn @ c2w[:, :3], c2w[:, 3]]), camera.fov, camera.aspect)
    middle = seen(of, turned)[HEIGHT // 2, WIDTH // 2 - 1]
    torch.testing.assert_close(middle, of.views.images[0, HEIGHT // 2, WIDTH // 2], atol=2e-3, rtol=0)


def test_from_elsewhere_it_stays_as_taken():
    of = photograph()
    camera = view_camera(of.views, 0)
    away = replace(camera, position=(9.0, 9.0, 9.0), wxyz=(1.0, 0.0, 0.0, 0.0))
    assert of.seen_from(camera)
    assert not of.seen_from(away)
    torch.testing.assert_close(seen(of, away), of.views.images[0], atol=1e-4, rtol=0)


def test_what_lies_behind_is_black():
    of = photograph()
    camera = view_camera(of.views, 0)
    back = (Rotation.from_quat(np.roll(camera.wxyz, -1)) * Rotation.from_rotvec([0, np.pi, 0])).as_quat()
    assert not seen(of, replace(camera, wxyz=tuple(np.roll(back, 1)))).any()


def test_lenses_are_undone():
    """A straight pinhole's pixel shows what the lens imaged there: ``r' = r (1 + k1 r^2)``."""
    k1 = 0.2
    of = photograph(torch.tensor([[k1, 0.0, 0.0, 0.0, 0.0]]))
    picture = seen(of, view_camera(of.views, 0))
    u = (torch.arange(WIDTH) + 0.5 - WIDTH / 2) / 30
    v = 0.5 / 30  # half a pixel below the axis
    expected = (30 * u * (1 + k1 * (u**2 + v**2)) + WIDTH / 2) / WIDTH
    inside = (expected > 1 / WIDTH) & (expected < 1 - 1 / WIDTH)
    torch.testing.assert_close(picture[HEIGHT // 2, inside, 0], expected[inside], atol=1e-4, rtol=0)


@pytest.mark.parametrize(("kind", "lifted"), [("rgb", False), ("lit", True), ("latent", True), ("depth", True)])
def test_it_is_lifted_unless_the_run_is_not(kind, lifted):
    of = photograph()
    rendered = of.render(Shot(view_camera(of.views, 0)), 6, 8, lambda: True)
    picture = of.picture(rendered, kind, 3.0)
    assert torch.equal(picture, brighten(rendered["rgb"], 3.0) if lifted else rendered["rgb"])
