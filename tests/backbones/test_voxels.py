"""DVGO's field in the world against a renderer in float64 that walks along one ray after the other."""

import math

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from ctm_plugin.backbones.marching import FeaturesAndDirections
from ctm_plugin.backbones.voxels import ViewMLP, VoxelField, WorldField
from ctm_plugin.cpu import blocked_mlp
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.encoding import embed
from ctm_plugin.rays.grid import VoxelGrid
from ctm_plugin.rays.sampling import intersect_box

BOX = torch.tensor([[-1.0, -0.5, -2.0], [1.0, 1.25, 0.5]])
SHAPE = (5, 4, 6)
NEAR, FAR, FEATURES = 0.5, 6.0, 4
TINY = 1e-12


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random_rays(count: int, seed: int = 0, box: torch.Tensor = BOX) -> Rays:
    """Rays from outside towards points in and about the box."""
    rng = generator(seed)
    origins = torch.randn(count, 3, generator=rng)
    origins = 3 * origins / origins.norm(dim=1, keepdim=True)
    aims = box[0] + (1.4 * torch.rand(count, 3, generator=rng) - 0.2) * (box[1] - box[0])
    directions = aims - origins
    return Rays(origins, directions / directions.norm(dim=1, keepdim=True))


def make_field(threshold: float = TINY, features: int = FEATURES, seed: int = 1, **settings) -> VoxelField:
    settings = {"alpha_init": 0.1, "step": 0.5, "base_voxel": 0.6} | settings
    field = WorldField(BOX, SHAPE, features, near=NEAR, far=FAR, threshold=threshold, **settings)
    with torch.no_grad():
        field.density.copy_(3 * torch.randn(field.density.shape, generator=generator(seed)) + 1)
        field.features.copy_(2 * torch.randn(field.features.shape, generator=generator(seed + 1)))
    return field


def make_mlp(channels: int = 3) -> ViewMLP:
    torch.manual_seed(5)
    mlp = ViewMLP(FEATURES, channels, width=8, depth=3, frequencies=2)
    with torch.no_grad():
        # Strong enough for colours that differ.
        for parameter in mlp.parameters():
            parameter.mul_(2)
    return mlp


class Slow:
    """A field's tables in float64, rendered sample by sample."""

    def __init__(self, field: VoxelField, mlp: ViewMLP | None):
        self.density = field.density.detach().double().numpy().reshape(*SHAPE, -1)
        self.features = field.features.detach().double().numpy().reshape(*SHAPE, -1)
        self.low, self.high = BOX.double().numpy()
        self.spacing = (self.high - self.low) / (np.array(SHAPE) - 1)
        self.voxel = (np.prod(self.high - self.low) / math.prod(SHAPE)) ** (1 / 3)
        self.step = field.step * self.voxel
        self.interval = self.step / field.base_voxel
        self.threshold = field.threshold
        self.shift = math.log(1 / (1 - 0.1) - 1)
        self.layers = None if mlp is None else [p.detach().double().numpy() for p in mlp.parameters()]

    def at(self, table, point):
        position = (point - self.low) / self.spacing
        first = np.minimum(position.astype(int), np.array(SHAPE) - 2)
        total = 0.0
        for corner in np.ndindex(2, 2, 2):
            weight = np.prod(np.where(corner, position - first, 1 - position + first))
            total = total + weight * table[tuple(first + corner)]
        return total

    def color(self, features, direction):
        if self.layers is not None:
            angles = [wave(2.0**p * direction) for wave in (np.sin, np.cos) for p in range(2)]
            features = np.concatenate([features, direction, *angles])
            for index, (matrix, bias) in enumerate(zip(self.layers[::2], self.layers[1::2], strict=True)):
                features = matrix @ (features if index == 0 else np.maximum(features, 0)) + bias
        return 1 / (1 + np.exp(-features))

    def inside(self, origin, direction):
        with np.errstate(divide="ignore"):
            ends = np.sort([(self.low - origin) / direction, (self.high - origin) / direction], axis=0)
        return max(NEAR, ends[0].max()), min(FAR, ends[1].min())

    def ray(self, origin, direction, background, offset):
        first, last = self.inside(origin, direction)
        light, latent, depth = 1.0, 0.0, 0.0
        t = first + offset * self.step
        while t < last:
            point = origin + t * direction
            raw = self.at(self.density, point).item()
            alpha = 1 - math.exp(-self.interval * math.log1p(math.exp(raw + self.shift)))
            if alpha > self.threshold:
                weight = light * alpha
                light *= 1 - alpha
                depth += weight * t
                if weight > self.threshold:
                    latent = latent + weight * self.color(self.at(self.features, point), direction)
            t += self.step
        return latent + light * background, depth + light * FAR, light

    def render(self, rays, background, offset):
        background = background.expand(len(rays.origins), -1).double().numpy()
        offset = torch.as_tensor(offset).expand(len(rays.origins)).double().numpy()
        columns = zip(rays.origins.double().numpy(), rays.directions.double().numpy(), background, offset, strict=True)
        return [torch.from_numpy(np.array(part)) for part in zip(*[self.ray(*row) for row in columns], strict=True)]


@pytest.mark.parametrize("threshold", [TINY, 0.06], ids=["dense", "thresholds"])
@pytest.mark.parametrize("kind", ["mlp", "features"])
@pytest.mark.parametrize("jitter", [False, True], ids=["middle", "jitter"])
@pytest.mark.parametrize("settings", [{}, {"step": 0.3, "base_voxel": 0.2}], ids=["", "fine_steps"])
def test_slow_renderer(threshold, kind, jitter, settings):
    mlp = make_mlp() if kind == "mlp" else None
    field = make_field(threshold, **settings)
    rays, background = random_rays(40), torch.rand(40, 3 if mlp else FEATURES, generator=generator(3))
    offset = torch.rand(40, generator=generator(4)) if jitter else 0.5
    latent, depth, samples = field(rays, background, offset, mlp)
    expected, distance, transmittance = Slow(field, mlp).render(rays, background, offset)
    torch.testing.assert_close(latent.double(), expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(depth.double(), distance, atol=5e-5, rtol=0)
    torch.testing.assert_close(samples.transmittance.double(), transmittance, atol=1e-5, rtol=0)
    # The rays are of all kinds: past the box, through thin and through thick parts.
    assert (transmittance == 1).sum() >= 3
    assert transmittance.min() < 0.1


@pytest.mark.parametrize("kind", ["mlp", "features"])
def test_gradients(kind):
    mlp = make_mlp() if kind == "mlp" else None
    field = make_field()
    rays, background = random_rays(12), torch.rand(1, 3 if mlp else FEATURES, generator=generator(3))
    cotangent = torch.randn(12, background.shape[1], generator=generator(6))
    latent, _, samples = field(rays, background, 0.5, mlp)
    ((latent * cotangent).sum() + samples.transmittance.sum()).backward()
    for seed, name in enumerate(["density", "features"]):
        table = getattr(field, name)
        way = torch.randn(table.shape, generator=generator(7 + seed))

        def loss(size, name=name, way=way):
            slow = Slow(field, mlp)
            moved = getattr(slow, name) + size * way.double().numpy().reshape(*SHAPE, -1)
            setattr(slow, name, moved)
            expected, _, transmittance = slow.render(rays, background, 0.5)
            return ((expected * cotangent).sum() + transmittance.sum()).item()

        slope = (loss(1e-4) - loss(-1e-4)) / 2e-4
        # Along a random way the slope is about as large as the gradient.
        size = table.grad.norm().item()
        assert size > 0.01
        assert (table.grad * way).sum().item() == pytest.approx(slope, abs=1e-3 * size)


def test_background_of_each_ray_or_of_all():
    field, rays = make_field(), random_rays(10)
    one = torch.rand(1, FEATURES)
    torch.testing.assert_close(field(rays, one, 0.5, None)[0], field(rays, one.expand(10, -1), 0.5, None)[0])


@pytest.mark.parametrize("empty", ["rays_past", "no_space"])
def test_nothing_in_the_way(empty):
    field, mlp, rays = make_field(), make_mlp(), random_rays(4)
    if empty == "rays_past":
        rays = Rays(rays.origins, -rays.directions)
    else:
        field.occupancy[:] = False
    background = torch.rand(4, 3)
    latent, depth, samples = field(rays, background, 0.5, mlp)
    assert torch.equal(latent, background)
    assert depth.tolist() == [FAR] * 4
    assert samples.transmittance.tolist() == [1] * 4
    assert len(samples.weights) == len(samples.latent) == len(samples.ray_index) == 0


def test_samples_add_up():
    field, mlp, rays = make_field(0.01), make_mlp(), random_rays(20)
    latent, _, samples = field(rays, torch.zeros(1, 3), 0.5, mlp)
    assert (samples.weights > 0.01).all()
    assert (samples.ray_index.diff() >= 0).all()
    sums = torch.zeros(20, 3).index_add_(0, samples.ray_index, samples.weights[:, None] * samples.latent)
    torch.testing.assert_close(latent, sums)


@pytest.mark.parametrize(("channels", "depth", "frequencies"), [(3, 2, 0), (1, 2, 4), (5, 4, 1)])
def test_view_mlp(channels, depth, frequencies):
    mlp = ViewMLP(FEATURES, channels, width=8, depth=depth, frequencies=frequencies)
    features, directions = torch.randn(6, FEATURES), random_rays(3).directions
    ray = torch.tensor([0, 0, 1, 1, 1, 2])
    matrices, biases = list(mlp.parameters())[::2], list(mlp.parameters())[1::2]
    assert len(matrices) == depth
    assert not biases[-1].any()
    d = directions[ray].double()
    hidden = torch.cat(
        [features.double(), d]
        + [torch.sin(2**p * d) for p in range(frequencies)]
        + [torch.cos(2**p * d) for p in range(frequencies)],
        dim=1,
    )
    for index, (matrix, bias) in enumerate(zip(matrices, biases, strict=True)):
        hidden = (hidden if index == 0 else hidden.clamp_min(0)) @ matrix.double().T + bias.double()
    torch.testing.assert_close(mlp(features, directions, ray).double(), 1 / (1 + torch.exp(-hidden)), atol=1e-6, rtol=0)


def view_gradients(mlp, features, directions, ray, way):
    """Output and gradients of one look at samples: in ``blocks``, ``whole``, or as the module does."""
    features = features.clone().requires_grad_()
    mlp.zero_grad()
    embedded, layers = embed(directions, mlp.frequencies), mlp.layers[::2]
    if way == "blocks":
        weights, biases = [layer.weight for layer in layers], [layer.bias for layer in layers]
        out = blocked_mlp.blocked_mlp(features, FeaturesAndDirections(embedded, ray), weights, biases)
    else:
        out = mlp.whole(features, embedded, ray) if way == "whole" else mlp(features, directions, ray)
    (out * torch.arange(1.0, out.numel() + 1).view_as(out).cos()).sum().backward()
    return [out, features.grad, *(parameter.grad for parameter in mlp.parameters())]


@pytest.mark.parametrize("samples", [0, 1, 8, 21])
@pytest.mark.parametrize("way", ["blocks", "module"])
def test_view_mlp_is_the_whole(samples, way, monkeypatch):
    monkeypatch.setattr(blocked_mlp, "BLOCK", 11 * 24 * 4)  # of the widest layer, the entry: whole strides of it
    monkeypatch.setattr(blocked_mlp, "STRIDE", 4)
    mlp = ViewMLP(FEATURES, 3, width=8, depth=3, frequencies=2)
    features, directions = torch.randn(samples, FEATURES), random_rays(5).directions
    ray = torch.randint(5, (samples,)).sort().values
    found, expected = (view_gradients(mlp, features, directions, ray, each) for each in (way, "whole"))
    for ours, plain in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, plain, atol=1e-6, rtol=1e-5)


def test_view_mlp_in_blocks_with_bfloat16_products():
    torch.manual_seed(0)
    mlp = ViewMLP(FEATURES, 3, width=64, depth=3, frequencies=4)
    features, directions = torch.randn(500, FEATURES), random_rays(5).directions
    ray = torch.randint(5, (500,)).sort().values
    exact = view_gradients(mlp, features, directions, ray, "whole")
    with torch.autocast("cpu", torch.bfloat16):
        blocks, plain = (view_gradients(mlp, features, directions, ray, way) for way in ("module", "whole"))
    for ours, theirs, true in zip(blocks, plain, exact, strict=True):
        assert ours.dtype == torch.float32
        assert 0 < (ours - true).norm() < 1.2 * (theirs - true).norm() + 1e-3 * true.norm()


@pytest.mark.parametrize("alpha_init", [1e-6, 0.01, 0.5])
def test_fresh_grid(alpha_init):
    voxel = VoxelGrid(BOX, SHAPE).voxel
    for interval in (1.0, 0.25):
        field = WorldField(
            BOX,
            SHAPE,
            3,
            near=NEAR,
            far=FAR,
            alpha_init=alpha_init,
            threshold=1e-4,
            step=0.5,
            base_voxel=0.5 * voxel / interval,
        )
        expected = torch.full(SHAPE, 1 - (1 - alpha_init) ** interval)
        torch.testing.assert_close(field.alpha(), expected, rtol=1e-4, atol=0)
        assert field.occupancy.all()


def test_alpha_is_of_each_vertex():
    field = make_field()
    alpha = field.alpha()
    for row, at in enumerate(np.ndindex(SHAPE)):
        depth = field.optical_depth(field.density[row], field.vertex_shift)
        assert alpha[at].item() == pytest.approx(1 - math.exp(-depth.item()), rel=1e-5)


def blob_field(threshold: float, seed: int) -> VoxelField:
    """Mostly free space, some vertices solid."""
    field = make_field(threshold, seed=seed)
    with torch.no_grad():
        solid = torch.rand(field.density.shape, generator=generator(seed)) < 0.04
        field.density.copy_(torch.where(solid, field.density + 4, -20.0))
    return field


@given(st.integers(0, 10**6))
def test_free_space_changes_nothing(seed):
    field, rays, background = blob_field(1e-3, seed), random_rays(50, seed), torch.rand(50, FEATURES)
    before = field(rays, background, 0.5, None)
    visited = len(field.occupied_samples(rays, 0.5)[0])
    field.update_occupancy()
    if field.occupancy.any() and not field.occupancy.all():
        assert len(field.occupied_samples(rays, 0.5)[0]) < visited
    after = field(rays, background, 0.5, None)
    torch.testing.assert_close(after[:2], before[:2])
    torch.testing.assert_close(after[2].weights, before[2].weights)


@given(st.integers(0, 10**6), st.floats(1e-4, 0.5))
def test_occupancy(seed, threshold):
    field = blob_field(threshold, seed)
    known_free = torch.rand(field.occupancy.shape, generator=generator(seed)) < 0.2
    field.occupancy &= ~known_free
    field.update_occupancy()
    alpha = field.alpha().numpy()
    for row, (x, y, z) in enumerate(np.ndindex(SHAPE)):
        around = alpha[max(x - 1, 0) : x + 2, max(y - 1, 0) : y + 2, max(z - 1, 0) : z + 2]
        assert field.occupancy[row] == (around.max() > threshold and not known_free[row])


@given(st.integers(0, 10**6))
def test_occupied_samples(seed):
    field, rays, offset = make_field(), random_rays(30, seed), torch.rand(30, generator=generator(seed))
    t, ray, points = field.occupied_samples(rays, offset)
    torch.testing.assert_close(points, rays.origins[ray] + t[:, None] * rays.directions[ray])
    assert ((points >= BOX[0] - 1e-5) & (points <= BOX[1] + 1e-5)).all()
    field.occupancy[:] = torch.rand(field.occupancy.shape, generator=generator(seed)) < 0.5
    kept = field.occupancy[field.grid.nearest(points)]
    for part, every in zip(field.occupied_samples(rays, offset), (t, ray, points), strict=True):
        assert torch.equal(part, every[kept])  # each by itself, by the same machine code


@given(
    st.tuples(*[st.integers(2, 30)] * 3),
    st.tuples(*[st.floats(0.3, 3)] * 3),
    st.integers(1, 3),
    st.integers(0, 10**6),
)
@example((2, 2, 30), (1.0, 1.0, 1.0), 1, 0)
@example((13, 13, 13), (1.0, 1.0, 1.0), 2, 0)
def test_hits_miss_no_ray(shape, size, solid, seed):
    """Rays aimed at a few solid vertices, many of them on a face, of boxes whose voxels are no cubes."""
    rng, count = generator(seed), 1000
    box = torch.tensor([[0.0, 0, 0], size]) - 0.5
    field = WorldField(box, shape, 1, near=NEAR, far=FAR, alpha_init=0.1, threshold=1e-4, step=0.5, base_voxel=1.0)
    last = torch.tensor(shape) - 1
    index = ((1.5 * torch.rand(solid, 3, generator=rng) - 0.25) * last).round().clamp(torch.zeros(3), last).long()
    field.occupancy[:] = False
    field.occupancy.view(shape)[tuple(index.T)] = True
    target = index[torch.arange(count) % solid] + torch.rand(count, 3, generator=rng) - 0.5
    target = box[0] + target.clamp(torch.zeros(3), last) * (box[1] - box[0]) / last
    origins = random_rays(count, seed, box).origins
    rays = Rays(origins, (target - origins) / (target - origins).norm(dim=1, keepdim=True))
    found = torch.zeros(count, dtype=torch.bool)
    found[field.occupied_samples(rays, torch.rand(count, generator=rng))[1]] = True
    assert not (found & ~field.hits(rays)).any()


def test_hits_leaves_free_rays_out():
    field = WorldField(
        BOX, (40, 40, 40), 1, near=NEAR, far=FAR, alpha_init=0.1, threshold=1e-4, step=0.5, base_voxel=1.0
    )
    rays = random_rays(2000)
    field.occupancy[:] = False
    assert not field.hits(rays).any()
    field.occupancy[(20 * 40 + 21) * 40 + 23] = True
    # The vertex stands in the block of vertices 20 to 23 along each side; with those round it 16 to 27.
    round_it = BOX[0] + torch.tensor([[15.5], [27.5]]) * (BOX[1] - BOX[0]) / 39
    enter, leave = intersect_box(rays, round_it, NEAR, FAR)
    hits = field.hits(rays)
    assert not hits[leave <= enter].any()
    assert hits[leave > enter + 4 * (BOX[1] - BOX[0]).norm() / 39].all()
    assert 0.05 < hits.float().mean() < 0.5


def linear(points: torch.Tensor, channels: int) -> torch.Tensor:
    return points @ torch.randn(3, channels, generator=generator(0)) + 0.3


@pytest.mark.parametrize("shape", [(9, 3, 7), SHAPE, (2, 2, 2)], ids=str)
def test_resize_keeps_a_linear_field(shape):
    field = make_field()
    tables = field.density, field.features
    for table in tables:
        table.data = linear(field.grid.vertices(), table.shape[1])
        table.grad = torch.ones_like(table)
    field.resize(shape)
    assert (field.density, field.features) == tables
    assert field.grid.shape == shape
    assert field.grid.voxel == pytest.approx((8.75 / math.prod(shape)) ** (1 / 3))
    assert torch.equal(field.grid.box, BOX)
    for table in tables:
        torch.testing.assert_close(table.data, linear(field.grid.vertices(), table.shape[1]), atol=1e-5, rtol=0)
        assert table.grad is None
        assert table.requires_grad
    assert len(field.occupancy) == math.prod(shape)


@given(st.integers(0, 10**6), st.tuples(*[st.integers(2, 10)] * 3))
def test_resize_keeps_what_is_there(seed, shape):
    field = blob_field(1e-3, seed)
    field.update_occupancy()
    free = ~field.occupancy
    nearest = field.grid.nearest
    field.resize(shape)
    assert field.occupancy[(field.alpha() > 1e-3).flatten()].all()
    assert not field.occupancy[free[nearest(field.grid.vertices())]].any()
    assert not field.occupancy[field.dilated_alpha() <= 1e-3].any()
