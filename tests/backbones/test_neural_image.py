"""The neural image: its encodings in closed form, and its blocks against the whole network."""

import math

import pytest
import torch

from ctm_plugin.backbones.neural_image import NeuralImage, shown_frequencies
from ctm_plugin.cpu import blocked_mlp


@pytest.fixture
def image() -> NeuralImage:
    torch.manual_seed(0)
    return NeuralImage(3, width=16, depth=3, frequencies=4).double()


def both(image: NeuralImage, points: torch.Tensor, shown: torch.Tensor | None = None):
    """Outputs and gradients, in blocks and in one go."""
    found = []
    for query in (image, lambda points, shown: whole(image, points, shown)):
        points = points.detach().requires_grad_()
        out = query(points, shown)
        weight = torch.linspace(-1, 1, out.numel()).view_as(out).to(out)
        grads = torch.autograd.grad((out * weight).sum(), [points, *image.parameters()])
        found.append([out.detach(), *grads])
    return found


def whole(image: NeuralImage, points: torch.Tensor, shown: torch.Tensor | None) -> torch.Tensor:
    """As the module does where it is not on a CPU, with the weights of frequencies on the embedding itself."""
    weights, biases = [layer.weight for layer in image.layers], [layer.bias for layer in image.layers]
    if shown is not None:
        count = len(shown)
        each = torch.ones(2 + 4 * count).to(shown)
        for band in range(count):
            for start in (2, 2 + 2 * count):
                each[start + 2 * band : start + 2 * band + 2] = shown[band]
        weights[0] = weights[0] @ torch.diag(each)
    return image._whole(points, weights, biases)


@pytest.mark.parametrize("rows", [1, 7, 8, 20])
@pytest.mark.parametrize("shown", [None, [1.0, 1.0, 0.5, 0.0]])
def test_blocks_are_the_whole(image, monkeypatch, rows, shown):
    monkeypatch.setattr(blocked_mlp, "BLOCK_BYTES", 8 * 24 * 8)  # eight rows of the widest layer, the entry
    monkeypatch.setattr(blocked_mlp, "ROW_MULTIPLE", 4)
    points = torch.rand(rows, 2, dtype=torch.float64) * 2 - 1
    shown = None if shown is None else torch.tensor(shown, dtype=torch.float64)
    for a, b in zip(*both(image, points, shown), strict=True):
        torch.testing.assert_close(a, b, atol=1e-11, rtol=1e-9)


def test_blocks_read_nothing_that_was_not_written(image):
    """Fresh memory is full of NaN: also where layers are filled up to whole blocks and columns."""
    torch.use_deterministic_algorithms(True)
    try:
        assert torch.empty(3).isnan().all()
        found, expected = both(image, torch.rand(20, 2, dtype=torch.float64))
    finally:
        torch.use_deterministic_algorithms(False)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-11, rtol=1e-9)


@pytest.mark.parametrize("depth", [1, 2])
def test_blocks_without_an_encoding(depth):
    image = NeuralImage(2, width=8, depth=depth, frequencies=0).double()
    for a, b in zip(*both(image, torch.rand(5, 2, dtype=torch.float64)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-12, rtol=1e-9)


def test_gradients(image):
    points = torch.rand(3, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(image, (points,), atol=1e-6)


def test_without_gradients_nothing_is_kept(image, monkeypatch):
    monkeypatch.setattr(blocked_mlp, "BLOCK_BYTES", 8 * 24 * 8)  # eight rows of the widest layer, the entry
    monkeypatch.setattr(blocked_mlp, "ROW_MULTIPLE", 4)
    points = torch.rand(20, 2, dtype=torch.float64)
    with torch.no_grad():
        assert torch.equal(image(points), image(points))  # the same call twice
        torch.testing.assert_close(image(points), image(points.clone().requires_grad_()).detach())


def test_bfloat16_products_keep_positions():
    torch.manual_seed(0)
    image = NeuralImage(3, width=64, depth=3, frequencies=0)
    points = torch.rand(500, 2) * 2 - 1
    exact = both(image, points)[0]
    with torch.autocast("cpu", torch.bfloat16):
        fast = both(image, points)[0]
    assert fast[0].dtype == torch.float32
    for a, b in zip(fast, exact, strict=True):
        assert (a - b).norm() < 0.1 * b.norm()
    # The first layer alone, where rounding positions is all that matters.
    line = NeuralImage(1, width=2, depth=1, frequencies=0)
    with torch.no_grad():
        line.layers[0].weight.copy_(torch.eye(2))
        line.layers[0].bias.fill_(1)
        line.layers[1].weight.fill_(1)
        line.layers[1].bias.fill_(-2)
    small = points[:, :1].expand(-1, 2) * 0.25  # a sum that bfloat16 holds to 2^-9
    with torch.autocast("cpu", torch.bfloat16):
        close = line(small)
    assert (close - line(small)).abs().max() < 2e-3


def test_embedding_in_closed_form():
    image = NeuralImage(1, width=16, depth=1, frequencies=2).double()
    with torch.no_grad():
        for parameter in image.parameters():
            parameter.zero_()
        # One hidden unit a column, added up.
        columns = image.layers[0].weight.shape[1]
        image.layers[0].weight[:columns] = torch.eye(columns)
        image.layers[0].bias[:] = 2
        image.layers[1].weight[:, :columns] = 1
        image.layers[1].bias[:] = -2 * columns
    x, y = 0.3, -0.6
    shown = torch.tensor([0.7, 0.2], dtype=torch.float64)
    waves = sum(
        weight * (math.sin(f * math.pi * v) + math.cos(f * math.pi * v))
        for f, weight in ((1, 0.7), (2, 0.2))
        for v in (x, y)
    )
    out = image(torch.tensor([[x, y]], dtype=torch.float64), shown)
    assert out.item() == pytest.approx(1 / (1 + math.exp(-(x + y + waves))))


def test_rescaled_first_layer():
    torch.manual_seed(0)
    plain = NeuralImage(3, width=8, depth=2, frequencies=8)
    torch.manual_seed(0)
    rescaled = NeuralImage(3, width=8, depth=2, frequencies=8, rescale=True)
    for index, (a, b) in enumerate(zip(plain.parameters(), rescaled.parameters(), strict=True)):
        torch.testing.assert_close(a * (math.sqrt(17) if index < 2 else 1), b)


@pytest.mark.parametrize(
    ("progress", "expected"),
    [
        (0.0, [0, 0, 0, 0]),
        (0.1, [1, 0, 0, 0]),
        (0.15, [1, 0.5, 0, 0]),
        (0.225, [1, 1, (1 - math.cos(math.pi / 4)) / 2, 0]),
        (0.4, [1, 1, 1, 1]),
        (1.0, [1, 1, 1, 1]),
    ],
)
def test_frequencies_come_in_one_after_another(progress, expected):
    shown = shown_frequencies(4, progress, 0.0, 0.4, torch.device("cpu"))
    torch.testing.assert_close(shown, torch.tensor(expected, dtype=torch.float32), atol=1e-6, rtol=0)


def test_frequencies_wait_for_their_start():
    assert shown_frequencies(2, 0.5, 0.5, 1.0, torch.device("cpu")).tolist() == [0, 0]
    torch.testing.assert_close(
        shown_frequencies(2, 0.75, 0.5, 1.0, torch.device("cpu")), torch.tensor([1.0, 0.0]), atol=1e-6, rtol=0
    )
