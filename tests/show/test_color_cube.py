"""The cube of colours before a transform and after it."""

import torch

from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.light import find_light
from ctm_plugin.color.settings import CTMConfig
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import seeded
from ctm_plugin.show.color_cube import DOT_RADIUS, PICTURE_SIDE, cube_picture, dots


class Shrunk(ColorTransform):
    """Latents in the corner next to black."""

    def encode(self, rgb):
        return rgb / 10


def quarters(picture: torch.Tensor) -> list[torch.Tensor]:
    return [
        picture[y : y + PICTURE_SIDE, x : x + PICTURE_SIDE]
        for y in (0, PICTURE_SIDE + 2)
        for x in (0, PICTURE_SIDE + 2)
    ]


def coloured(picture: torch.Tensor) -> torch.Tensor:
    """Pixels that are not grey."""
    return picture.amax(-1) - picture.amin(-1) > 0.1


def test_the_identity_leaves_both_cubes_as_they_are():
    lattice, encoded, scene, encoded_scene = quarters(cube_picture(RGB(), torch.rand(50, 3)))
    assert torch.equal(lattice, encoded)
    assert torch.equal(scene, encoded_scene)
    assert coloured(lattice).float().mean() > 0.1


def test_points_move_and_keep_their_colour():
    lattice, encoded, _, _ = quarters(cube_picture(Shrunk(), torch.rand(50, 3)))
    assert coloured(encoded).any()
    assert coloured(encoded).sum() < coloured(lattice).sum() / 10


def test_dark_colours_are_shown_lifted():
    dark = torch.rand(200, 3) * 0.05
    _, _, scene, encoded = quarters(cube_picture(Shrunk(), dark, find_light(dark)))
    assert scene[coloured(scene)].max() > 0.6
    assert coloured(scene).any()
    assert coloured(encoded).any()


def test_any_number_of_channels():
    for k in (1, 2, 3, 5):
        with seeded(0):
            picture = cube_picture(CTM(CTMConfig(k=k, width=8)), torch.rand(50, 3))
        assert picture.shape == (2 * PICTURE_SIDE + 2, 2 * PICTURE_SIDE + 2, 3)
        assert picture.isfinite().all()


def test_nearer_dots_are_in_front():
    # On a line to the viewer: the first component comes nearer, and so do the others a little.
    away, near = torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0.5, 0.5, 0.5])
    near = near + 0.3 * torch.tensor([0.8214, 0.3830, 0.4226])
    for order in ((0, 1), (1, 0)):
        places, colors = torch.stack([away, near])[list(order)], torch.eye(3)[:2][list(order)]
        middle = dots(places, colors)[PICTURE_SIDE // 2, PICTURE_SIDE // 2]
        assert middle.tolist() == [0, 1, 0]


def test_every_corner_is_in_the_picture():
    corners = torch.cartesian_prod(*3 * [torch.tensor([0.0, 1.0])])
    for corner in corners:
        picture = dots(corner[None], torch.tensor([[1.0, 0, 0]]))
        assert int(coloured(picture).sum()) >= (2 * DOT_RADIUS) ** 2
