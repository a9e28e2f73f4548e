import imageio.v3 as iio
import pytest
import torch
import torch.nn.functional as F

from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.lpips_weights import load_lpips

NETS = ("alex", "vgg")
SIZE = 40


@pytest.fixture(scope="module", params=NETS)
def model(request):
    torch.manual_seed(0)
    return LPIPS(request.param)


def images(seed: int, *shape: int):
    return torch.rand(*shape, 3, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("other", "expected"), [("p0", 0.7219), ("p1", 0.1376)])
def test_released_example_values(ctm_data, other, expected):
    folder = ctm_data / "lpips"
    model, reason = load_lpips(folder / "alexnet_features.npz")
    assert reason == ""
    first, second = (
        torch.from_numpy(iio.imread(folder / f"ex_{name}.png")[..., :3]).float() / 255 for name in ("ref", other)
    )
    assert float(model(first, second)) == pytest.approx(expected, abs=1e-4)


# Convolutions: stride, padding, whether a pooling of 3 by 2 (AlexNet) or 2 by 2 (VGG-16) comes before, and whether
# LPIPS compares what comes after.
LAYERS = {
    "alex": [(4, 2, False, True), (1, 2, True, True), (1, 1, True, True), (1, 1, False, True), (1, 1, False, True)],
    "vgg": [
        (1, 1, block > 0 and layer == 0, layer == depth - 1)
        for block, depth in enumerate((2, 2, 3, 3, 3))
        for layer in range(depth)
    ],
}  # fmt: skip
CHANNELS = {"alex": [64, 192, 384, 256, 256], "vgg": [64] * 2 + [128] * 2 + [256] * 3 + [512] * 6}
KERNELS = {"alex": [11, 5, 3, 3, 3], "vgg": [3] * 13}


def published(model: LPIPS, first: torch.Tensor, second: torch.Tensor) -> float:
    """The distance of two images, from the papers' description of the networks and the formula, in float64."""
    shift, scale = (
        torch.tensor(numbers, dtype=torch.float64)[:, None, None]
        for numbers in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
    )
    maps = [((2 * image.double().permute(2, 0, 1) - 1 - shift) / scale)[None] for image in (first, second)]
    parameters, heads, total = list(model.features.double().parameters()), iter(model.heads), 0.0
    for index, (stride, padding, pooled, compared) in enumerate(LAYERS[model.net]):
        if pooled:
            maps = [F.max_pool2d(x, 3 if model.net == "alex" else 2, 2) for x in maps]
        weight, bias = parameters[2 * index : 2 * index + 2]
        maps = [F.conv2d(x, weight, bias, stride, padding).clamp_min(0) for x in maps]
        if compared:
            units = [x / x.square().sum(1, keepdim=True).sqrt() for x in maps]
            total += float((next(heads).double() * (units[0] - units[1]) ** 2).sum(1).mean())
    return total


@pytest.mark.parametrize("net", NETS)
def test_distance_is_the_published_one(net):
    torch.manual_seed(0)
    model = LPIPS(net)
    weights = [parameter for parameter in model.features.parameters() if parameter.dim() == 4]
    assert [weight.shape[0] for weight in weights] == CHANNELS[net]
    assert [weight.shape[2:] for weight in weights] == [(side, side) for side in KERNELS[net]]
    for head in model.heads:
        head.copy_(torch.rand(head.shape))
    first, second = images(0, 61, 70), images(1, 61, 70)
    distance = float(model(first, second))
    assert distance == pytest.approx(published(model, first, second), rel=1e-4)


def test_equal_images_have_no_distance(model):
    image = images(0, 2, SIZE, SIZE)
    assert torch.equal(model(image, image), torch.zeros(2))  # the network is called twice with the same


def test_distance_is_positive_symmetric_and_per_image(model):
    first, second = images(0, 2, SIZE, SIZE + 3), images(1, 2, SIZE, SIZE + 3)
    distance = model(first, second)
    assert (distance > 0).all()
    assert torch.equal(model(second, first), distance)  # the same calls; a difference and its negative have one square
    torch.testing.assert_close(torch.stack([model(a, b) for a, b in zip(first, second, strict=True)]), distance)
    assert model(first[0], second[0]).shape == ()


@pytest.mark.parametrize("level", [0.0, 0.5])
def test_gradient_is_finite_even_on_flat_images(model, level):
    prediction = torch.full((SIZE, SIZE, 3), level, requires_grad=True)
    model(prediction, images(1, SIZE, SIZE)).backward()
    assert prediction.grad.isfinite().all()
    assert prediction.grad.abs().max() > 0


def test_score_does_not_depend_on_the_precision_of_the_run(model):
    first, second = images(0, SIZE, SIZE), images(1, SIZE, SIZE)
    outside = model(first, second)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(model(first, second), outside)


def test_smallest_image_that_fits_works_and_one_pixel_less_does_not(model):
    side = model.min_size
    assert model(images(0, side, side), images(1, side, side)).isfinite()
    assert not model.fits(side, side - 1)
    with pytest.raises(RuntimeError):  # the limit is the network's, not ours
        model.features(torch.rand(1, 3, side - 1, side - 1))
