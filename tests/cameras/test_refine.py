"""Patches that are laid over one another: moves that are known, and a model in noise."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from ctm_plugin.cameras.refine import PatchObservations, blurred, looked_up, moved

SIDE, COUNT = 96, 6


def scene(moves: torch.Tensor, noise: float) -> dict[int, torch.Tensor]:
    """Pictures of one painting, each moved by so many columns and rows."""
    chance = np.random.default_rng(0)
    painting = gaussian_filter(chance.normal(size=(SIDE, SIDE)), 2.5)
    grid = torch.stack(torch.meshgrid(*[torch.arange(SIDE) + 0.5] * 2, indexing="ij")[::-1], -1)
    lights = {}
    for view, move in enumerate(moves):
        light, _ = looked_up(torch.from_numpy(painting).float(), (grid - move).reshape(-1, 1, 2))
        dark = light.reshape(SIDE, SIDE) / painting.std()
        lights[view + 1] = blurred(dark + torch.from_numpy(chance.normal(size=(SIDE, SIDE))).float() * noise, 1.5)
    return lights


def observations(axes: torch.Tensor) -> PatchObservations:
    """Four points that are seen in the middle of four quarters, by all alike."""
    places = torch.cartesian_prod(*[torch.tensor([32.0, 64.0])] * 2)
    return PatchObservations(torch.arange(4), [*range(4)], places, axes.expand(4, 2, 2))


@pytest.mark.parametrize(("noise", "most"), [(0.0, 0.1), (1.0, 0.35)])
def test_moves_are_found_but_for_a_common_one(noise, most):
    chance = torch.Generator().manual_seed(0)
    moves = torch.randn(COUNT, 2, generator=chance) * 0.7
    seen = {view + 1: observations(torch.eye(2)) for view in range(COUNT)}
    found = moved(seen, scene(moves, noise), 10)
    places = torch.stack([torch.from_numpy(found[view][1]).float() - seen[view].middles for view in seen])
    error = (places - places.mean(0)) - (moves - moves.mean(0))[:, None]
    assert all(all(good) for _, _, good in found.values())
    assert error.norm(dim=-1).mean() < most < (moves - moves.mean(0)).norm(dim=1).mean()


def test_patches_follow_how_a_picture_is_turned():
    """The second picture is the first upside down: what is to the right there is to the left here."""
    lights = scene(torch.zeros(COUNT, 2), 0.0)
    lights[2] = lights[2].flip(0, 1)
    seen = {view + 1: observations(torch.eye(2)) for view in range(COUNT)}
    upside = observations(-torch.eye(2))
    seen[2] = upside._replace(middles=SIDE - upside.middles + torch.tensor([0.9, -0.8]))
    found = torch.from_numpy(moved(seen, lights, 10)[2][1]).float()
    torch.testing.assert_close(found, SIDE - upside.middles, atol=0.3, rtol=0)


def test_what_cannot_be_told_does_not_count():
    """One picture shows something else; a patch reaches out of another."""
    lights = scene(torch.zeros(COUNT, 2), 0.0)
    lights[2] = 4 * lights[2].flip(0)
    seen = {view: observations(torch.eye(2)) for view in lights}
    seen[1].middles[0] = torch.tensor([5.0, 32.0])
    good = {view: kept for view, (_, _, kept) in moved(seen, lights, 10).items()}
    assert good == {view: [view not in (1, 2)] + [view != 2] * 3 for view in lights}


def test_light_is_looked_up_between_pixels():
    light = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
    values, inside = looked_up(light, torch.tensor([[[0.5, 0.5], [1.0, 1.0]], [[1.5, 1.5], [1.6, 1.0]]]))
    torch.testing.assert_close(values[:, 0], torch.tensor([0.0, 3.0]))
    assert values[0, 1] == 1.5
    assert inside.tolist() == [True, False]
