"""Results of loaders: a :class:`Scene` with two sets of posed :class:`Views`, or a :class:`PlanarScene`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from torch import Tensor

from ctm_plugin.scene.kinds import Background, Geometry
from ctm_plugin.scene.poses import Similarity

DARK_LEVEL = 0.3
"""Level of sRGB below which pictures count as dark."""
DERIVED = {"derived": True}
"""Metadata of fields that follow from others and the files: no part of the data's fingerprint."""
ADDED = {"added": True}
"""Metadata of fields that older versions lack: where they are ``None``, the data's fingerprint stays as it was."""
Pixels = UInt8[Tensor, "*shape c"] | Float32[Tensor, "*shape c"]
"""sRGB of 3 channels, or 4 with *straight* alpha: 8 bits, or float32 in [0, 1] where files have more."""


@dataclass(frozen=True)
class Views:
    """Posed images of one split, all of one size.

    Attributes:
        images: ``[N, H, W, C]``, see :data:`Pixels`. Colour where alpha is 0 is 0.
        c2w: ``[N, 3, 4]`` camera to world, OpenGL axes (x right, y up, looking along -z).
        intrinsics: ``[N, 4]`` (fx, fy, cx, cy) in pixels; the centre of the first pixel is at (0.5, 0.5).
        names: one name a view, unique, for files and tables.
        depth: ``[N, H, W]`` true distance along the ray in scene units, NaN where the ray hits nothing.
        distortion: ``[N, 5]`` (k1, k2, p1, p2, k3) of the lenses, see :func:`ctm_plugin.rays.cameras.distort`; ``None``
            for pinholes.
        mask: ``[N, H, W]``, which pixels count: the others are neither trained on nor scored; ``None``: all do.
        pictured: ``[N]``, whether a test view has a photograph; the others are rendered and not scored, their
            ``images`` are black. ``None``: all have one.
        lit: ``[N, H, W, 3]``, the same views in normal light, 8 bits: only references for lit pictures, which nothing
            is trained on or fitted to. ``None``: there are none.
        exposures: ``[N]``, the light that each training picture took by its EXIF, up to one factor; NaN where it does
            not tell. ``None``: none tells.
        gains: ``[N]``, natural logarithms of the training pictures' gains, by the light of points, up to one offset;
            NaN: too few points. ``None``: not measured.
        sizes: ``[N, 2]`` height and width of pictures that differ, each in the upper left corner of its image;
            ``None``: all fill theirs.
    """

    images: UInt8[Tensor, "n h w c"] | Float32[Tensor, "n h w c"]
    c2w: Float32[Tensor, "n 3 4"]
    intrinsics: Float32[Tensor, "n 4"]
    names: tuple[str, ...]
    depth: Float32[Tensor, "n h w"] | None = None
    distortion: Float32[Tensor, "n 5"] | None = None
    mask: Bool[Tensor, "n h w"] | None = field(default=None, metadata=ADDED)
    pictured: Bool[Tensor, " n"] | None = field(default=None, metadata=ADDED)
    lit: UInt8[Tensor, "n h w 3"] | None = field(default=None, metadata=ADDED)
    exposures: Float32[Tensor, " n"] | None = field(default=None, metadata=ADDED)
    gains: Float32[Tensor, " n"] | None = field(default=None, metadata=DERIVED)
    sizes: Int64[Tensor, "n 2"] | None = field(default=None, metadata=DERIVED)

    def __len__(self) -> int:
        return len(self.images)

    @property
    def height(self) -> int:
        return self.images.shape[1]

    @property
    def width(self) -> int:
        return self.images.shape[2]

    @cached_property
    def extents(self) -> Int64[Tensor, "n 2"]:
        """Width and height ``[N, 2]`` of the part of each picture that counts, from its upper left corner."""
        sides = torch.tensor([self.width, self.height])
        if self.mask is None:
            return sides.expand(len(self), 2)
        last = [(self.mask.any(axis).cpu() * torch.arange(1, side + 1)).amax(1) for axis, side in enumerate(sides, 1)]
        return torch.stack(last, 1).clamp_min(1)

    def size(self, index: int) -> tuple[int, int]:
        """Height and width of a view's own picture."""
        return (self.height, self.width) if self.sizes is None else tuple(self.sizes[index].tolist())

    @property
    def largest(self) -> int:
        """Number of the largest picture, the first of several."""
        return max(range(len(self)), key=lambda index: math.prod(self.size(index)))

    def own(self, index: int, image: Tensor) -> Tensor:
        """The part of a view's image ``[H, W, ...]`` that its picture fills."""
        height, width = self.size(index)
        return image[:height, :width]

    @property
    def has_alpha(self) -> bool:
        return self.images.shape[3] == 4


@dataclass(frozen=True)
class Points:
    """Points on the surfaces of a scene, as a reconstruction found them.

    Attributes:
        positions: ``[P, 3]`` in the scene's world.
        point, view: ``[T]``: training view ``view[i]`` sees point ``point[i]``; both are empty where that is unknown.
    """

    positions: Float32[Tensor, "p 3"]
    point: Int64[Tensor, " t"]
    view: Int64[Tensor, " t"]


@dataclass(frozen=True)
class Scene:
    """A data set ready to train on.

    Attributes:
        name: the data set's name in tables.
        train, test: training and test views.
        near, far: bounds along the (unit) ray directions, in scene units.
        geometry: ``bounded`` (cameras around an object), ``forward`` (NDC is valid) or ``unbounded``.
        background: what rays that hit nothing show, see docs/method.md.
        exposure: light relative to a normal exposure where it is known, else ``None``.
        background_level: how bright random backgrounds are, see :class:`ctm_plugin.data.settings.PhotoConfig`.
        world: similarity from the files' world to the scene's; ``None``: the two are the same.
        points: surface points of the files' reconstruction; ``None``: there are none.
        light: light in which the scene's pictures are displayed, where there are no photographs to find it from.
    """

    name: str
    train: Views
    test: Views
    near: float
    far: float
    geometry: Geometry
    background: Background
    exposure: float | None = None
    background_level: float | int | str | None = None
    world: Similarity | None = field(default=None, metadata=DERIVED)
    points: Points | None = field(default=None, metadata=DERIVED)
    light: tuple[float, float, float] | None = field(default=None, metadata=DERIVED)

    @cached_property
    def random_level(self) -> float | None:
        """Random background colours lie in [0, level]^3; ``None``: they are drawn in the transform's own space."""
        return bright_level(self.train) if self.background_level == "scene" else self.background_level

    @cached_property
    def dark(self) -> bool:
        """Whether the training pictures are dark: 99 % of their colours lie below 0.3 of full scale.

        All channels of all pixels with alpha > 0 count, as sRGB, unless they are masked. Lego reaches 1.0 in full
        light, 0.15 at exposure 0.02.
        """
        return bright_level(self.train) < DARK_LEVEL


@dataclass(frozen=True)
class PlanarScene:
    """One picture, and patches of it under homographies, to be aligned: what BARF-2D is trained on.

    Attributes:
        name: in tables: the picture's name.
        image: ``[H, W, 3]`` sRGB in [0, 1], dimmed, of 8 bits.
        true_warps: ``[5, 8]`` parameters of the homographies, see :func:`ctm_plugin.rays.homography.sl3_exp`; they take
            the patch in the middle of the picture to where its colours come from. The first is 0.
        patches: ``[5, P, P, 3]`` as trained on, with noise where there is any.
        clean: ``[5, P, P, 3]`` without noise, for metrics.
        exposure: light relative to the photograph's.
    """

    name: str
    image: Float[Tensor, "h w 3"]
    true_warps: Float[Tensor, "n 8"]
    patches: Float[Tensor, "n p p 3"]
    clean: Float[Tensor, "n p p 3"]
    exposure: float

    @property
    def height(self) -> int:
        return self.image.shape[0]

    @property
    def width(self) -> int:
        return self.image.shape[1]

    @property
    def patch(self) -> int:
        return self.patches.shape[1]


def bright_level(views: Views, quantile: float = 0.99) -> float:
    """The smallest level that at least ``quantile`` of the colours do not exceed.

    Args:
        views: all channels of all pixels with alpha > 0 count that no mask takes out.
        quantile: in (0, 1].

    Returns:
        sRGB in [0, 1], of 8 bits as the pictures are, else of 16; 0 where no pixel counts.
    """
    levels = 255 if views.images.dtype == torch.uint8 else 65535
    counts = torch.zeros(levels + 1, dtype=torch.int64)
    for index, image in enumerate(views.images):
        colours = image if views.mask is None else image[views.mask[index]]
        colours = colours[colours[..., 3] > 0][:, :3] if views.has_alpha else colours
        codes = colours if levels == 255 else (colours * levels).round().int()
        counts += torch.bincount(codes.flatten(), minlength=levels + 1)
    enough = counts.cumsum(0) >= quantile * counts.sum()
    return enough.to(torch.uint8).argmax().item() / levels


def unit(image: Pixels) -> Float32[Tensor, "*shape c"]:
    """Pixels as float32 in [0, 1]."""
    return image.to(torch.float32) / 255.0 if image.dtype == torch.uint8 else image


def composite(image: Pixels, background: Tensor) -> Tensor:
    """Put straight-alpha pixels over a background: ``a c + (1 - a) b``.

    Args:
        image: ``[..., 3]`` or ``[..., 4]``.
        background: broadcastable to ``[..., 3]``, in [0, 1].

    Returns:
        ``[..., 3]`` float32 in [0, 1].
    """
    image = unit(image)
    if image.shape[-1] == 3:
        return image
    alpha = image[..., 3:]
    return image[..., :3] * alpha + (1.0 - alpha) * background
