"""Real spherical harmonics: written out, orthonormal, and the addition theorem."""

import math

import pytest
import torch

from ctm_plugin.rays.spherical_harmonics import harmonics


def directions(count: int = 40) -> torch.Tensor:
    rng = torch.Generator().manual_seed(0)
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=rng, dtype=torch.float64), dim=1)


def test_written_out():
    """Degrees 0 to 3, as tables of real spherical harmonics have them, without the Condon-Shortley phase."""
    d = directions()
    x, y, z = d.T
    root = {n: math.sqrt(n / math.pi) for n in (1, 3, 5, 7, 15, 21, 35, 105)}
    expected = [
        0.5 * root[1] * torch.ones_like(x),
        *(math.sqrt(3 / (4 * math.pi)) * each for each in (y, z, x)),
        0.5 * root[15] * x * y,
        0.5 * root[15] * y * z,
        0.25 * root[5] * (3 * z**2 - 1),
        0.5 * root[15] * x * z,
        0.25 * root[15] * (x**2 - y**2),
        0.25 * math.sqrt(35 / (2 * math.pi)) * y * (3 * x**2 - y**2),
        0.5 * root[105] * x * y * z,
        0.25 * math.sqrt(21 / (2 * math.pi)) * y * (5 * z**2 - 1),
        0.25 * root[7] * (5 * z**3 - 3 * z),
        0.25 * math.sqrt(21 / (2 * math.pi)) * x * (5 * z**2 - 1),
        0.25 * root[105] * (x**2 - y**2) * z,
        0.25 * math.sqrt(35 / (2 * math.pi)) * x * (x**2 - 3 * y**2),
    ]
    torch.testing.assert_close(harmonics(d, 4), torch.stack(expected, dim=1))


@pytest.mark.parametrize("degrees", [1, 3, 6])
def test_orthonormal(degrees):
    """By Gauss's rule in z and equal angles round it, exact for products of these degrees."""
    import numpy as np

    nodes, weights = (torch.from_numpy(each) for each in np.polynomial.legendre.leggauss(degrees))
    angle = torch.arange(2 * degrees, dtype=torch.float64) * math.pi / degrees
    side = (1 - nodes**2).sqrt()[:, None]
    points = torch.stack([side * angle.cos(), side * angle.sin(), nodes[:, None].expand(-1, 2 * degrees)], dim=-1)
    found = harmonics(points.flatten(0, 1), degrees)
    area = (weights[:, None] * math.pi / degrees).expand(-1, 2 * degrees).flatten()
    torch.testing.assert_close((found * area[:, None]).T @ found, torch.eye(degrees**2, dtype=torch.float64))


def test_addition_theorem():
    """``sum_m Y_lm(d)^2 = (2 l + 1) / 4 pi`` for every direction."""
    found = harmonics(directions(), 5).square()
    for degree in range(5):
        total = found[:, degree**2 : (degree + 1) ** 2].sum(1)
        torch.testing.assert_close(total, torch.full_like(total, (2 * degree + 1) / (4 * math.pi)))
