"""What stands behind the scene in training, the colours that it starts from, the rays of a picture's pixels."""

import math
from dataclasses import replace

import pytest
import torch

from ctm_plugin.backbones.radiance import RayRendering
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError
from ctm_plugin.rays.cameras import camera_rays
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.scene.views import bright_level


@pytest.fixture
def backgrounds(compose):
    """4000 backgrounds: the colours under the pictures and the latents under the renderings."""

    def draw(*arguments: str):
        parts = assemble(compose("dataset.exposure=0.05", *arguments))
        module = parts.backbone
        return module, *module.backgrounds(Draws(0, 0), 4000)

    return draw


def spread(values: torch.Tensor) -> tuple[float, float]:
    return values.min().item(), values.max().item()


def test_random_without_a_transform_is_the_whole_cube(backgrounds):
    _, behind, latent = backgrounds("ctm=off", "dataset.background=random")
    assert torch.equal(behind, torch.zeros(1, 3))
    assert spread(latent) == pytest.approx((0, 1), abs=0.01)
    assert latent.mean().item() == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("space", ["rgb", "gain"])
@pytest.mark.parametrize(
    ("level", "black", "ends"),
    [(0.05, 0.3, (0.02, 0.04)), (0.3, 0.3, (0.06, 0.12)), (0.3, 0.0, (0, 0.3)), (0.5, 0.3, (0, 1))],
)
def test_random_lies_around_a_dark_scene_s_black(compose, space, level, black, ends):
    run = compose("ctm=auto", f"ctm.black={black}", f"color_space={space}", "dataset.background=random")
    parts = assemble(run)
    module, transform = parts.backbone, parts.backbone.transform
    module.transform = transform
    (transform.inner if space == "gain" else transform).begin(torch.full((8, 3), level))
    _, latent = module.backgrounds(Draws(0, 0), 4000)
    assert spread(latent) == pytest.approx(ends, abs=0.01 * ends[1])
    assert latent.mean().item() == pytest.approx(sum(ends) / 2, abs=0.02)


def test_what_pictures_get_as_well_is_no_darker_than_black(backgrounds):
    """Of the still life, whose pictures have alpha: colours up to the brightest of the scene, encoded."""
    module, behind, latent = backgrounds("ctm=auto", "dataset.background=random_matched")
    module.transform.begin(torch.full((8, 3), 0.2))
    behind, latent = module.backgrounds(Draws(0, 0), 4000)
    assert spread(behind) == pytest.approx((0, 0.2), abs=0.01)
    assert (behind[1::4] > 0).all()
    torch.testing.assert_close(latent, module.transform.encode(behind))


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


@pytest.mark.parametrize("ctm", ["off", "quick"])
@pytest.mark.parametrize("backbone", ["dvgo", "nerf", "ngp"])
def test_colours_start_at_the_scene_s_mean(compose, backbone, ctm):
    """With a transform and without: the sigmoid of the last layers' biases is the mean encoded training colour."""
    parts = assemble(compose(f"backbone={backbone}", f"ctm={ctm}", "dataset.exposure=0.05"))
    module = parts.backbone
    module.on_train_start()
    pixels = module.scene_colors(Draws(0, 0), 1 << 15)
    biases = module.color_biases()
    assert len(biases) == {"dvgo": 1, "nerf": 2, "ngp": 1}[backbone]
    for bias in biases:
        # Two draws of 2^15 colours: their means differ by the colours' deviation over 128 or so.
        torch.testing.assert_close(bias.sigmoid(), module.transform.encode(pixels).mean(0), atol=0.02, rtol=0)
        bias.data.fill_(7.0)
    module.batches_seen = 1  # a run that goes on
    module.on_train_start()
    assert all((bias == 7).all() for bias in biases)


@pytest.mark.parametrize("backbone", ["dvgo", "nerf", "ngp"])
def test_colours_may_start_at_grey(compose, backbone):
    module = assemble(compose(f"backbone={backbone}", "backbone.start=grey", "dataset.exposure=0.05")).backbone
    before = {name: value.clone() for name, value in module.named_parameters()}
    module.on_train_start()
    assert module.color_biases() == []
    assert all(torch.equal(value, before[name]) for name, value in module.named_parameters())


@pytest.mark.parametrize("weight", [1.0, 43.0])
def test_the_loss_s_weight_reaches_every_photometric_term(compose, weight):
    """DVGO's per-point colour error is one of them, its regularisers are not."""
    terms = {}
    for factor in (1.0, weight):
        sizes = ("ctm=off", "backbone.coarse=false", f"loss.weight={factor}")
        module = assemble(compose("backbone=dvgo", *sizes)).backbone
        module.training_step(None, 0)
        terms[factor] = module.terms
    assert terms[1.0].keys() == {"color", "entropy", "point"}
    for name, factor in {"color": weight, "point": weight, "entropy": 1.0}.items():
        torch.testing.assert_close(terms[weight][name], factor * terms[1.0][name])


@pytest.mark.parametrize("backbone", ["dvgo", "ngp"])
def test_a_relative_loss_keeps_its_scale_however_often_a_run_goes_on(compose, backbone):
    """A checkpoint may be read twice by one run, and be the second of a run that was stopped twice."""
    parts = assemble(compose(f"backbone={backbone}", "ctm=off", "backbone.relative=true", "loss.weight=2"))
    module = parts.backbone
    module.on_train_start()
    weight = module.photometric.weight
    assert weight == pytest.approx(2 * module.loss_scale)
    assert module.loss_scale != 1
    for _ in range(2):
        saved = {"state_dict": module.state_dict()}
        module.on_save_checkpoint(saved)
        module = type(module)(module.config, module.scene, photometric=parts.backbone.photometric, seed=0)
        module.photometric = replace(module.photometric, weight=2.0)
        module.on_load_checkpoint(saved)
        module.on_load_checkpoint(saved)
        assert module.photometric.weight == weight
    with pytest.raises(ValueError, match="a loss of nan times"):
        module.on_load_checkpoint(saved | {"loss_scale": math.nan})


@pytest.fixture
def masked(compose):
    """A backbone on a scene whose left half is masked and red, the rest as it was."""

    def make(*arguments: str):
        parts = assemble(compose("ctm=off", "dataset.background=black", *arguments))
        scene = parts.scene
        views = scene.train
        mask = (torch.arange(views.width) >= views.width // 2).expand(views.images.shape[:3])
        images = torch.where(mask[..., None], views.images, views.images.new_tensor([255, 0, 0, 255]))
        scene = replace(scene, train=replace(views, images=images, mask=mask))
        module = type(parts.backbone)(parts.backbone.config, scene, seed=0)
        return module

    return make


@pytest.mark.parametrize("backbone", ["dvgo", "nerf", "ngp"])
def test_masked_pixels_are_never_drawn(masked, backbone):
    module = masked(f"backbone={backbone}")
    mask = module.scene.train.mask.flatten()
    drawn = []
    rays = module.training_rays
    module.training_rays = lambda pixel: drawn.append(pixel) or rays(pixel)
    for step in range(4):
        module.draw(Draws(0, step))
    assert all(mask[pixel].all() for pixel in drawn)
    assert len(torch.cat(drawn).unique()) > 100
    red = torch.tensor([1.0, 0.0, 0.0])
    assert not (module.scene_colors(Draws(0, 0), 1000) == red).all(-1).any()


def test_the_pool_of_rays_holds_no_masked_pixel(masked):
    module = masked("backbone=dvgo")
    module.field.occupancy[0] = False
    module.field.hits = lambda rays: torch.arange(len(rays.origins)) % 2 == 0  # every other ray meets something
    module.renew_pool()
    mask = module.scene.train.mask.flatten()
    assert torch.equal(module.pool.long(), mask.nonzero().squeeze(1)[::2])


def test_the_first_steps_middle_holds_no_masked_pixel(masked):
    module = masked("backbone=nerf")
    pixel, views = module.middle_pixels().long(), module.scene.train
    assert views.mask.flatten()[pixel].all()
    assert len(pixel) == len(views) * (views.height // 2) * (views.width // 4)


@pytest.mark.parametrize("alpha", [False, True])
def test_deep_pixels_train_as_8_bit_ones(compose, alpha):
    """The same colours in float32 give the same batches."""
    parts = assemble(compose("ctm=off"))
    scene, config = parts.scene, parts.backbone.config
    images = scene.train.images if alpha else scene.train.images[..., :3]
    batches = []
    for stored in (images, images.float() / 255):
        module = type(parts.backbone)(config, replace(scene, train=replace(scene.train, images=stored)), seed=0)
        batches.append(module.draw(Draws(0, 0)))
    torch.testing.assert_close(batches[0].rgb, batches[1].rgb)


@pytest.fixture
def ramp(compose, monkeypatch):
    """A backbone whose rays show their direction and how far into a stride their samples begin."""
    module = assemble(compose("dataset.exposure=0.05", "ctm=off")).backbone
    drawn = []

    def render(rays, background, draws):
        drawn.append(draws)
        offset = torch.full_like(rays.origins[:, :1], 0.5) if draws is None else draws.uniform(len(rays.origins), 1)
        latent = torch.cat([0.5 + rays.directions[:, :2] / 2, offset], dim=1)
        return RayRendering((latent,), opacity=offset[:, 0], depth=rays.directions[:, 0])

    monkeypatch.setattr(module, "render", render)
    return module, drawn


def test_one_ray_a_pixel_is_its_centre_s_and_draws_nothing(ramp):
    module, drawn = ramp
    view = module.render_view(module.scene.test, 0)
    assert set(drawn) == {None}
    assert (view["opacity"] == 0.5).all()


@pytest.mark.parametrize("every", [1, 3])
def test_a_picture_is_the_mean_of_each_pixel_s_rays(ramp, every):
    module, drawn = ramp
    test = module.scene.test
    module.rays_per_pixel = 4
    view = module.render_view(test, 1, every)
    row, column = torch.meshgrid(torch.arange(test.height), torch.arange(test.width), indexing="ij")
    directions = []
    for right in (-0.125, 0.125):
        for down in (-0.125, 0.125):
            x, y = (column + 0.5 + right).flatten(), (row + 0.5 + down).flatten()
            each = (of_all[1:2].expand(len(x), *of_all.shape[1:]) for of_all in (test.c2w, test.intrinsics))
            directions.append(camera_rays(*each, x, y).directions.view(test.height, test.width, 3)[::every, ::every])
    mean = torch.stack(directions).mean(0)
    torch.testing.assert_close(
        view["latent"], torch.cat([0.5 + mean[..., :2] / 2, torch.full_like(mean[..., :1], 0.5)], 2)
    )
    torch.testing.assert_close(view["depth"], mean[..., 0])
    torch.testing.assert_close(view["opacity"], torch.full_like(mean[..., 0], 0.5))
    torch.testing.assert_close(view["rgb"], module.decode(view["latent"]))
    assert {draws.number for draws in drawn} == {0.125, 0.375, 0.625, 0.875}


@pytest.mark.parametrize("backbone", ["dvgo", "ngp"])
def test_rays_a_pixel_by_the_configuration(compose, backbone, monkeypatch):
    """Of the field, too, whose samples begin where they are told."""
    module = assemble(compose(f"backbone={backbone}", "trainer=smoke", "ctm=off", "backbone.rays_per_pixel=4")).backbone
    own, begun = type(module.field).forward, set()

    def forward(self, rays, background, offset, *more):
        begun.update(offset.unique().tolist())
        return own(self, rays, background, offset, *more)

    monkeypatch.setattr(type(module.field), "forward", forward)
    module.eval().render_view(module.scene.test, 0)
    assert begun == {0.125, 0.375, 0.625, 0.875}
