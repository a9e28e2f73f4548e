"""What stands behind the scene in training."""

import pytest
import torch

from ctm_plugin.assemble import assemble
from ctm_plugin.data.scene import bright_level
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError


@pytest.fixture
def backgrounds(compose):
    """4000 backgrounds: the colours under the pictures and the latents under the renderings."""

    def draw(*arguments: str):
        parts = assemble(compose("dataset.exposure=0.05", *arguments))
        module = parts.backbone
        module.transform = parts.attach.transform
        return module, *module._backgrounds(Draws(0, 0), 4000)

    return draw


def spread(values: torch.Tensor) -> tuple[float, float]:
    return values.min().item(), values.max().item()


def test_random_without_a_transform_is_the_whole_cube(backgrounds):
    _, behind, latent = backgrounds("ctm=off", "dataset.background=random")
    assert torch.equal(behind, torch.zeros(1, 3))
    assert spread(latent) == pytest.approx((0, 1), abs=0.01)
    assert latent.mean().item() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("ctm", ["off", "quick"])
def test_as_bright_as_a_level(backgrounds, ctm):
    module, _, latent = backgrounds(f"ctm={ctm}", "dataset.background=random", "dataset.background_level=0.3")
    expected = module.transform.encode(0.3 * Draws(0, 0).uniform(4000, 3))
    torch.testing.assert_close(latent, expected)
    module, behind, latent = backgrounds(
        f"ctm={ctm}", "dataset.background=random_matched", "dataset.background_level=0.3"
    )
    assert spread(behind) == pytest.approx((0, 0.3), abs=0.01)
    torch.testing.assert_close(latent, module.transform.encode(behind))
    assert not behind[::4].any()  # a quarter of the rays sees evaluation's


def test_as_bright_as_the_scene(backgrounds):
    module, behind, _ = backgrounds("ctm=off", "dataset.background=random_matched", "dataset.background_level=scene")
    level = bright_level(module.scene.train)
    assert 0.1 < level < 0.5
    assert behind.max().item() == pytest.approx(level, abs=0.01)


@pytest.mark.parametrize("level", ["0", "1.5", "bright"])
def test_levels_that_cannot_be(compose, level):
    with pytest.raises(ConfigError, match=r"dataset\.background_level: found .*, expected a number in \(0, 1\], scene"):
        assemble(compose(f"dataset.background_level={level}"))
