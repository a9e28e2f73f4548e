import pytest
import torch

from ctm_plugin.scene.views import Scene, Views


@pytest.fixture(scope="session")
def wall() -> Scene:
    """A forward-facing scene: cameras in a plane that look along -z, with noise for pictures."""
    random = torch.Generator().manual_seed(0)
    c2w = torch.eye(3, 4).repeat(6, 1, 1)
    c2w[:, :2, 3] = 0.3 * torch.randn(6, 2, generator=random)
    images = torch.randint(256, (6, 8, 10, 3), generator=random, dtype=torch.uint8)
    views = Views(images, c2w, torch.tensor([[9.0, 9.0, 5.0, 4.0]]).repeat(6, 1), tuple("abcdef"))
    return Scene("wall", views, views, near=1.0, far=20.0, geometry="forward", background="black")
