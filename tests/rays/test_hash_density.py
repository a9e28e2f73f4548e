"""Densities out of a hash grid, and which samples light reaches: ray by ray in float64."""

import torch

from ctm_plugin.rays.hash_density import MAX_LOG_DENSITY, log_density, visible_samples
from ctm_plugin.rays.hash_grid import HashGrid


def test_samples_that_light_reaches():
    """Alpha, and the light that comes there, above the threshold; with their features. Densities have their end."""
    torch.manual_seed(0)
    grid, first, last = HashGrid(2, 2, 64, 2, 5), torch.nn.Linear(4, 8), torch.nn.Linear(8, 3)
    torch.nn.init.normal_(grid.table)
    torch.nn.init.normal_(last.weight, std=3.0)
    points, lengths = torch.rand(300, 3), 0.2 * torch.rand(300)
    ray_index = torch.arange(300) // 12
    network = grid.table, grid.sides, grid.starts, first, last
    kept, features = visible_samples(*network, points, lengths, ray_index, 25, 0.05)
    raw = last(first(grid(points)).relu())[:, 0].double()
    torch.testing.assert_close(log_density(*network, points).double(), raw, atol=1e-5, rtol=1e-5)
    alpha = 1 - (-raw.clamp_max(MAX_LOG_DENSITY).exp() * lengths).exp()
    expected = [
        12 * ray + at
        for ray, row in enumerate(alpha.view(25, 12))
        for at in range(12)
        if row[at] > 0.05 and (1 - row[:at]).prod() > 0.05
    ]
    assert 30 < len(expected) < 200
    assert kept.tolist() == expected
    torch.testing.assert_close(features, grid(points)[kept], atol=1e-6, rtol=0)
    with torch.no_grad():
        last.bias[0] += 1000.0
    assert log_density(*network, points).min() > MAX_LOG_DENSITY
    only, _ = visible_samples(*network, points, torch.tensor([1e-8]), ray_index, 25, 1e-3)
    assert len(only) == 300  # exp(15) * 1e-8 of alpha each
