"""Voxel grids as tables: trilinear lookup, resampling, nearest vertices.

A grid over a box has its outer vertices on the box's faces. Its values stand in a table ``[X Y Z, channels]``,
z fastest, so that the channels of one vertex are one contiguous row.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from ctm_plugin.door import looped

Shape = tuple[int, int, int]


class Corners(NamedTuple):
    """The eight vertices round each point: rows of the table and trilinear weights, ``[M, 8]``."""

    rows: Int[Tensor, "m 8"]
    weights: Float[Tensor, "m 8"]


class VoxelGrid(nn.Module):
    """The vertices of a grid over a box ``[2, 3]`` (its lowest and highest corner), ``shape`` = (X, Y, Z), each >= 2.

    Attributes:
        voxel: cube root of the box's volume by vertex, in the box's units: a voxel's edge where voxels are cubes.
    """

    def __init__(self, box: Float[Tensor, "2 3"], shape: Shape):
        super().__init__()
        self.shape = shape
        self.voxel = voxel_size(box, math.prod(shape))
        _, ny, nz = shape
        last = torch.tensor(shape, dtype=torch.float32) - 1
        offsets = [(i * ny + j) * nz + k for i in (0, 1) for j in (0, 1) for k in (0, 1)]
        for name, value in {
            "aabb": box.float(),
            "last": last,
            "scale": last / (box[1] - box[0]).float(),
            "offsets": torch.tensor(offsets, dtype=torch.int32),
        }.items():
            self.register_buffer(name, value, persistent=False)

    @property
    def count(self) -> int:
        return math.prod(self.shape)

    def corners(self, points: Float[Tensor, "m 3"]) -> Corners:
        """Find vertices and weights for trilinear interpolation; points outside are taken to the nearest face."""
        return Corners(*corners(points, self.aabb[0], self.scale, self.last, self.offsets))

    def nearest(self, points: Float[Tensor, "m 3"]) -> Int[Tensor, " m"]:
        """Find the row of the vertex nearest to each point; points outside are taken to the nearest face."""
        return nearest_rows(points, self.aabb[0], self.scale, self.last, self.offsets)

    def nearest_index(self, points: Float[Tensor, "m 3"]) -> Int[Tensor, "m 3"]:
        """Find the vertex nearest to each point by its index along each side."""
        return _position(points, self.aabb[0], self.scale, self.last).round_().int()

    def axes(self) -> list[Tensor]:
        """List the vertices' coordinates along each side, ``[X]``, ``[Y]``, ``[Z]``."""
        sides = zip(*self.aabb.tolist(), self.shape, strict=True)
        return [torch.linspace(a, b, n, device=self.aabb.device) for a, b, n in sides]

    def vertices(self) -> Float[Tensor, "v 3"]:
        """List the positions of all vertices, in the table's order."""
        return torch.cartesian_prod(*self.axes())

    def vertices_at(self, rows: Int[Tensor, " m"]) -> Float[Tensor, "m 3"]:
        """Find the positions of some rows' vertices."""
        _, ny, nz = self.shape
        index = rows // (ny * nz), rows // nz % ny, rows % nz
        return torch.stack([axis[at] for axis, at in zip(self.axes(), index, strict=True)], dim=-1)

    def box_around(self, chosen: Bool[Tensor, " v"]) -> Float[Tensor, "2 3"]:
        """Bound the cells, half a voxel to all sides, of the chosen vertices, within the grid's box; without vertices
        the box has its corners exchanged."""
        volume, ends = chosen.view(self.shape), []
        for axis, others in zip(self.axes(), ((1, 2), (0, 2), (0, 1)), strict=True):
            some = volume.any(others[1]).any(others[0])
            ends.append([torch.where(some, axis, torch.inf).amin(), torch.where(some, axis, -torch.inf).amax()])
        low, high = torch.stack([torch.stack(each) for each in ends], dim=1)
        half = 0.5 / self.scale
        return torch.stack([low - half, high + half]).clamp(*self.aabb)


def _position(points: Tensor, low: Tensor, scale: Tensor, last: Tensor) -> Tensor:
    return torch.clamp((points - low) * scale, torch.zeros_like(last), last)


def _rows(index: Int[Tensor, "m 3"], offsets: Int[Tensor, " 8"]) -> Int[Tensor, " m"]:
    x, y, z = index.unbind(-1)
    return z + y * offsets[2] + x * offsets[4]


def nearest_rows(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor) -> Tensor:
    """Find the rows ``[M]`` of the vertices nearest to points ``[M, 3]``, given a grid's lowest corner and buffers."""
    return _rows(_position(points, low, scale, last).round_().int(), offsets)


@looped("samples:corners", kernel="lookup:corners")
def corners(points: Tensor, low: Tensor, scale: Tensor, last: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Find the rows and weights ``[M, 8]`` of :class:`Corners`, of points ``[M, 3]`` and a grid's buffers."""
    position = _position(points, low, scale, last)
    below = torch.minimum(position.floor(), last - 1)
    x, y, z = (position - below).unbind(-1)
    yz = torch.stack([(1 - y) * (1 - z), (1 - y) * z, y * (1 - z), y * z], dim=-1)
    weights = torch.cat([yz * (1 - x)[:, None], yz * x[:, None]], dim=-1)
    return _rows(below.int(), offsets)[:, None] + offsets, weights


def voxel_size(box: Float[Tensor, "2 3"], voxels: int) -> float:
    """Tell the edge of a voxel when ``voxels`` of them fill the box: ``(volume / voxels)^(1/3)``, in scene units."""
    return float(((box[1] - box[0]).double().prod() / voxels) ** (1 / 3))


def cubic_shape(box: Float[Tensor, "2 3"], voxels: int) -> Shape:
    """Count vertices along each side so that about ``voxels`` cubic voxels fill the box; at least 2 a side."""
    size = voxel_size(box, voxels)
    # A thousandth of a voxel for rounding: a cube of n^3 voxels has n a side, not n - 1.
    nx, ny, nz = (max(2, int(length / size + 1e-3)) for length in (box[1] - box[0]).tolist())
    return nx, ny, nz


def plane_shape(box: Float[Tensor, "2 3"], voxels: int, planes: int) -> Shape:
    """Count vertices along each side of a box: ``planes`` planes along z, some ``voxels`` voxels, square in x, y."""
    width, height, _ = (box[1] - box[0]).tolist()
    size = math.sqrt(width * height * planes / voxels)
    return max(2, int(width / size + 1e-3)), max(2, int(height / size + 1e-3)), planes


class _Lookup(torch.autograd.Function):
    """``embedding_bag`` over the corners; its own gradient is far slower than adding up rows."""

    @staticmethod
    def forward(ctx, table, rows, weights, sparse):
        ctx.save_for_backward(rows, weights)
        ctx.shape, ctx.sparse = table.shape, sparse
        return weighted(table, rows, weights)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        return scattered(*ctx.saved_tensors, grad, ctx.shape, ctx.sparse), None, None, None


# Of rows with several numbers torch's own is as fast on a CPU.
@looped("lookup:numbers_at", when=lambda table, *_: table.shape[1] == 1, kernel="lookup:weighted")
def weighted(table: Tensor, rows: Tensor, weights: Tensor) -> Tensor:
    """Sum ``weights[m, i] table[rows[m, i]]`` over i: ``[M, c]`` of rows and weights ``[M, 8]``, table ``[V, c]``."""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


@looped("lookup:gradient", kernel="lookup:scattered")
def scattered(rows: Tensor, weights: Tensor, grad: Tensor, shape: torch.Size, sparse: bool) -> Tensor:
    """Add up the gradient of :func:`weighted` for a table of that shape; the CPU loop may give it ``sparse``.

    Args:
        rows, weights: ``[M, 8]``.
        grad: ``[M, c]``.
        shape: (V, c).
        sparse: whether the result may be a sparse tensor.
    """
    spread = (grad[:, None, :] * weights[:, :, None]).flatten(0, 1)
    # 64-bit indices: with 32-bit ones torch leaves its fast path on the CPU and takes ten times as long.
    return grad.new_zeros(shape).index_add_(0, rows.flatten().long(), spread)


def lookup(table: Float[Tensor, "v c"], at: Corners, sparse: bool = False) -> Float[Tensor, "m c"]:
    """Interpolate trilinearly: ``sum_i weights_i table[rows_i]``; differentiable in the table only.

    Args:
        table: values of the vertices.
        at: the corners of each point.
        sparse: give the table a sparse gradient, of the rows that were touched, on a CPU, if the table has several
            times as many numbers as the points have corners: filling and searching all of a large grid would take
            longer than the rest of a step.
    """
    return _Lookup.apply(table, at.rows, at.weights, sparse)


def as_volume(table: Float[Tensor, "v c"], shape: Shape) -> Float[Tensor, "c x y z"]:
    """View a table as a volume, channels first."""
    return table.T.reshape(-1, *shape)


def resample(table: Float[Tensor, "v c"], old: Shape, new: Shape) -> Float[Tensor, "w c"]:
    """Resample a table trilinearly to another number of vertices over the same box.

    Plane by plane, so that nothing as large as the grid is needed besides the result.
    """
    volume, resampled = table.view(*old, -1), table.new_empty(*new, table.shape[1])
    (x, along_x), (y, along_y), (z, along_z) = (_places(*counts) for counts in zip(old, new, strict=True))
    y, along_y, z, along_z = (each.to(table.device) for each in (y, along_y[:, None, None], z, along_z[:, None]))
    for plane, low, share in zip(resampled, x.tolist(), along_x.tolist(), strict=True):
        columns = torch.lerp(volume[low], volume[low + 1], share)
        rows = torch.lerp(columns.index_select(0, y), columns.index_select(0, y + 1), along_y)
        torch.lerp(rows.index_select(1, z), rows.index_select(1, z + 1), along_z, out=plane)
    return resampled.view(-1, table.shape[1])


def _places(old: int, new: int) -> tuple[Tensor, Tensor]:
    """Positions of a resampled side's new vertices: the old vertex before each, and the share of the way on."""
    place = torch.arange(new, dtype=torch.float64) * ((old - 1) / (new - 1))
    low = place.floor().clamp_(max=old - 2)
    return low.long(), (place - low).float()


@torch.no_grad()
def add_smoothing(
    table: Float[Tensor, "v c"], shape: Shape, weights: tuple[float, float, float], seen_only: bool = False
) -> None:
    """Add to a table's gradient that of its total variation, in place.

    Total variation: ``sum over axes a of weights[a] sum over neighbours along a of huber(difference)``, with Huber's
    function, quadratic up to 1, so that the gradient of a pair is its difference cut to [-1, 1] (DVGO's way).

    Args:
        table: with a gradient.
        shape: vertices along each side.
        weights: along x, y, z.
        seen_only: skip rows that have no gradient.
    """
    if not seen_only:
        _smooth_all(table, table.grad, shape, weights)
        return
    # All rows under a mask: gathering the seen ones and their neighbours takes longer, and would synchronise.
    pull = torch.zeros_like(table)
    _smooth_all(table, pull, shape, weights)
    table.grad.add_(pull.mul_((table.grad != 0).any(1, keepdim=True)))


def _smooth_all(table: Tensor, gradient: Tensor, shape: Shape, weights: tuple[float, float, float]) -> None:
    values, gradient = table.view(*shape, -1), gradient.view(*shape, -1)
    for axis, weight in enumerate(weights):
        length = shape[axis] - 1
        pull = (values.narrow(axis, 1, length) - values.narrow(axis, 0, length)).clamp_(-1, 1).mul_(weight)
        gradient.narrow(axis, 1, length).add_(pull)
        gradient.narrow(axis, 0, length).sub_(pull)
