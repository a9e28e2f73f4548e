"""The settings of all backbones; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass

from ctm_plugin.color.settings import LOSS_KINDS
from ctm_plugin.scene.kinds import GEOMETRIES
from ctm_plugin.settings.setting import Settings, by_geometry, setting

COLOR_STARTS = ("mean", "grey")
"""A field's colours before its first step: the scene's mean, or the middle of the latent cube."""
DVGO_GEOMETRIES = ("bounded", "forward")
"""Geometries that DVGO trains on."""
COARSE, ALONE = {"coarse": (True, "auto")}, {"coarse": (False, "auto")}
"""Values of ``coarse`` with which DVGO's settings of a coarse stage have an effect, and those of a run without one."""
BARF = {"encoding": ("barf",)}
"""Values of ``encoding`` with which settings of BARF's schedule have an effect."""
SQUARES = tuple(side * side for side in range(1, 17))
"""Numbers that are a square of an integer: pixels of an averaging square."""


@dataclass(frozen=True, kw_only=True)
class FieldConfig(Settings, section="backbone"):
    """Settings of all fields whose rays are marched."""

    start: str = setting(
        "mean",
        "colour of the field before the first step (of DVGO's fine stage): mean (the scene's mean colour) or grey",
        choices=COLOR_STARTS,
    )
    threshold: float = setting(
        1e-4, "samples (of DVGO's fine stage) with less alpha or less weight are skipped", above=0, below=1
    )
    averaged: int = setting(
        0,
        "pictures are rendered with a running mean of the parameters over about this many steps; 0: with the last ones",
        least=0,
    )
    rays_per_pixel: int = setting(
        1,
        "rays a pixel of rendered pictures, a square number; they cover the middle quarter of the pixel",
        choices=SQUARES,
    )
    relative: bool = setting(
        True,
        "divide the colour loss by 12 times the variance of the scene's colours, as regularisers do not depend on "
        "the light",
    )
    distortion: float = by_geometry(
        0.0, 0.01, "weight of the distortion loss, which gathers each ray's weight in one place", least=0
    )
    occlusion: float = setting(0.0, "weight of the loss on density close to the cameras", least=0)


@dataclass(frozen=True, kw_only=True)
class DVGOConfig(FieldConfig):
    """Settings of DVGO. The defaults are the paper's (DVGO's own for Synthetic-NeRF and LLFF).

    Unbounded scenes are refused: ``backbone=ngp`` takes them. ``trainer=quick`` is made for pictures of 100 to 250
    pixels a side, ``trainer=standard`` for about 500x375. On a CPU, numba compiles loops at the first run. It keeps
    the result next to the package, in the user's cache, or in ``NUMBA_CACHE_DIR``.
    """

    geometry: str | None = setting(
        None,
        "bounded: voxels in a box of the world; forward: planes of voxels in NDC; null: bounded, and other scenes "
        "are refused",
        composed="${oc.select:dataset.geometry,null}",
    )
    coarse: bool | str = setting(
        "auto",
        "whether a coarse stage comes first: true, false, or auto (on bounded scenes with alpha that are not dark)",
        choices=(True, False, "auto"),
    )
    coarse_steps: int = setting(5000, "steps of the coarse stage", least=1, only=COARSE)
    coarse_voxels: int = setting(100**3, "voxels of the coarse grid", least=8, only=COARSE)
    steps: int = setting(20000, "steps of the fine stage when a coarse stage comes first", least=1, only=COARSE)
    steps_alone: int = setting(30000, "steps of the fine stage when there is no coarse stage", least=1, only=ALONE)
    voxels: int = by_geometry(160**3, 256**3, "voxels of the fine grid at its full size", least=8)
    grow: tuple[int, ...] = by_geometry(
        (1000, 2000, 3000, 4000),
        (2000, 4000, 6000, 8000),
        "steps of the fine stage at which the number of voxels doubles",
    )
    threshold: float = by_geometry(
        1e-4, 1e-3, "samples of the fine stage with less alpha or less weight are skipped", above=0, below=1
    )
    relative: bool = False
    restart: bool = setting(
        True,
        "restart Adam and its learning rates when the grid grows; false: resample Adam's moments, let the rates go on",
    )
    shift_drop: float = setting(
        1.0, "how much each growth subtracts from the number that is added to raw densities before softplus", least=0
    )
    rays: int = by_geometry(8192, 4096, "rays a step, over all processes", least=1)
    features: int = by_geometry(12, 9, "channels of the feature grid", least=1)
    step_size: float = setting(
        0.5, "distance between samples on a ray, in voxels (bounded) or planes (forward)", above=0
    )
    coarse_lr_grid: float = setting(0.1, "learning rate of the coarse stage's grids", above=0, only=COARSE)
    lr_grid: float = setting(0.1, "learning rate of the fine stage's grids", above=0)
    lr_mlp: float = setting(1e-3, "learning rate of the fine stage's colour network", above=0)
    lr_decay_steps: int | None = setting(
        20000,
        "steps in which learning rates fall to lr_final; null: all steps of the fine stage, or of a longer coarse one",
        least=1,
    )
    lr_final: float = setting(
        0.1,
        "factor that learning rates fall to after lr_decay_steps, when a coarse stage comes first",
        above=0,
        only=COARSE,
    )
    lr_final_alone: float = setting(
        0.1,
        "factor that learning rates fall to after lr_decay_steps, when there is no coarse stage",
        above=0,
        only=ALONE,
    )
    coarse_entropy: float = setting(
        0.01,
        "weight of the background entropy, which makes rays opaque or empty, in the coarse stage",
        least=0,
        only=COARSE,
    )
    occupancy_first: int = setting(
        500,
        "step of the fine stage at which empty space is first looked for, then at 2, 4, 8, ... times that step",
        least=1,
    )
    planes: int = setting(
        128, "planes of voxels on scenes with geometry=forward", least=2, only={"geometry": ("forward",)}
    )
    tv_density: float = by_geometry(
        0.0, 1e-5, "weight of the density grid's total variation in the fine stage", least=0
    )
    tv_features: float = by_geometry(
        0.0, 1e-6, "weight of the feature grid's total variation in the fine stage", least=0
    )
    tv_dense_steps: int = setting(
        10000, "steps of the fine stage in which total variation also smooths voxels that no ray has met", least=0
    )
    tv_every: int = setting(
        1, "total variation is applied every so many steps, with its weight multiplied by that number", least=1
    )

    def __post_init__(self) -> None:
        if self.geometry not in (None, *DVGO_GEOMETRIES):
            raise self.fault("geometry", "bounded or forward: unbounded scenes need backbone=splat, ngp or nerf")
        super().__post_init__()
        if list(self.grow) != sorted({step for step in self.grow if step > 0}):
            raise self.fault("grow", "rising step numbers > 0")
        if self.geometry == "forward" and self.coarse is True:
            raise self.fault("coarse", "false or auto: forward-facing scenes have no coarse stage")


@dataclass(frozen=True, kw_only=True)
class NGPConfig(FieldConfig):
    """Settings of NGP. The defaults are the paper's, where it has them.

    In ``unbounded`` scenes, what stands among the cameras is resolved finely, and what lies behind it more coarsely
    with its distance. ``rays_per_pixel=1`` makes pictures in a quarter of the time. On a CPU, tables of 2^16 rows stay
    in a core's cache, and other ``features`` than 2 are far slower.
    """

    geometry: str = setting(
        "bounded",
        "bounded: a box of the world; forward: NDC; unbounded: all of space, contracted into a ball",
        composed="${oc.select:dataset.geometry,bounded}",
        choices=GEOMETRIES,
    )
    steps: int = setting(20_000, "training steps", least=1)
    rays: int = setting(4096, "rays a step, over all processes", least=1)
    samples: int = setting(1024, "samples on a ray through the whole space, those in empty space included", least=2)
    levels: int = setting(16, "levels of the hash grid", least=1)
    features: int = setting(2, "numbers that each vertex of a level holds; 2 has a fast loop on a CPU", least=1)
    log2_entries: int = setting(
        19, "base-2 logarithm of the largest number of rows of a level's table", least=4, most=28
    )
    coarsest: int = setting(16, "cells a side of the coarsest level", least=2)
    finest: int = setting(2048, "cells a side of the finest level", least=1)
    width: int = setting(64, "width of both networks' hidden layers", least=1)
    degrees: int = setting(
        4,
        "degrees of the viewing direction's spherical harmonics; 1: colours do not depend on the direction",
        least=1,
        most=8,
    )
    cells: int = setting(128**3, "cells of the occupancy grid, which says where space is empty", least=8)
    free_below: float = setting(
        0.01,
        "cells of the occupancy grid are empty below this alpha, if they are also below the mean alpha",
        above=0,
        most=1,
    )
    occupancy_first: int = setting(256, "step at which empty space is first looked for", least=1)
    occupancy_every: int = setting(16, "steps between later looks for empty space", least=1)
    occupancy_share: float = setting(
        0.25,
        "share of the occupancy grid's cells that each look visits, and as many again of those not empty",
        above=0,
        most=1,
    )
    free_for_good: float = setting(
        0.0,
        "alpha below which cells stay empty for good after 16, 32, 64, ... looks, if their neighbours are below "
        "it; only with alpha",
        least=0,
        most=1,
    )
    lr_grid: float = setting(1e-2, "learning rate of the hash grid", above=0)
    lr_mlp: float = setting(1e-2, "learning rate of the networks", above=0)
    lr_final: float = setting(0.1, "factor that learning rates fall to by the last step", above=0)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.finest < self.coarsest:
            raise self.fault("finest", f"at least backbone.coarsest, {self.coarsest}")


@dataclass(frozen=True, kw_only=True)
class NeRFConfig(Settings, section="backbone"):
    """Settings of NeRF. The defaults are the paper's (NeRF's own for Synthetic-NeRF).

    A run that ends as an empty scene has ``converged`` false in its ``metrics.json``.
    """

    geometry: str = setting(
        "bounded",
        "how samples are spaced along rays: bounded (evenly in distance), forward (evenly in NDC) or unbounded "
        "(evenly in inverse distance)",
        composed="${oc.select:dataset.geometry,bounded}",
        choices=GEOMETRIES,
    )
    steps: int = setting(100_000, "training steps", least=1)
    rays: int = setting(1024, "rays a step, over all processes", least=1)
    coarse_samples: int = setting(64, "samples a ray of the coarse network", least=3)
    fine_samples: int = setting(
        128, "further samples a ray of the fine network, which also gets the coarse network's", least=1
    )
    width: int = setting(256, "width of both networks' hidden layers", least=2)
    depth: int = setting(8, "number of both networks' hidden layers", least=2)
    skip: int = setting(5, "number, from 0, of the layer that gets the embedded position again", least=1)
    lr: float = setting(5e-4, "learning rate", above=0)
    lr_decay_steps: int = by_geometry(500_000, 250_000, "steps in which the learning rate falls to a tenth", least=1)
    crop_steps: int = by_geometry(
        500, 0, "first steps, in which only the middle half of each picture's width and height is trained on", least=0
    )
    density_noise: float = by_geometry(
        0.0, 1.0, "standard deviation of the noise that is added to densities in training", least=0
    )
    start: str = setting(
        "mean",
        "colour of the field before the first step: mean (the scene's mean colour) or grey (as in NeRF)",
        choices=COLOR_STARTS,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.skip >= self.depth:
            raise self.fault("skip", f"a layer from 1 to {self.depth - 1}")


@dataclass(frozen=True, kw_only=True)
class SplatConfig(Settings, section="backbone"):
    """Settings of Gaussian splats. The defaults are those of 3DGS.

    Captures (``dataset=colmap``, ``dataset=transforms``) train splats when no backbone is named. On a GPU Triton's
    kernels composite them; without it they stay on the processor. More of ``bend``, ``opacity`` and ``size`` makes
    better surfaces between the views, and slightly worse views.
    """

    steps: int = setting(30000, "training steps", least=1)
    views: int = setting(1, "training views a step, over all processes", least=1)
    coarse: bool = setting(
        True, "begin with pictures averaged over squares of pixels, for as long as their detail teaches something"
    )
    degree: int = setting(
        3,
        "degree of the viewing direction's spherical harmonics, 0 to 3; 0: colours do not depend on the direction",
        least=0,
        most=3,
    )
    degree_every: int = setting(1000, "steps after which the next degree is learned as well", least=1)
    first: int = setting(
        10000, "random Gaussians to begin with, used where the capture has fewer than 300 points", least=1
    )
    grow_from: int = setting(500, "step from which Gaussians are added", least=0)
    grow_until: int = setting(15000, "step until which Gaussians are added", least=0)
    grow_every: int = setting(100, "steps between additions of Gaussians", least=1)
    threshold: float = setting(
        2e-4, "a Gaussian is doubled when its place in the picture has a larger gradient than this", above=0
    )
    per_pixel: float = setting(
        0.02,
        "largest number of Gaussians, divided by the number of pixels of all training pictures, of 40 at least",
        above=0,
    )
    pruned: float = setting(0.005, "Gaussians with less opacity are removed", above=0)
    reset_every: int = setting(
        3000,
        "steps, up to grow_until, between resets that make all Gaussians nearly transparent; 0: no resets",
        least=0,
    )
    dssim: float = setting(
        0.2, "share of structural dissimilarity in the loss; absolute differences have the rest", least=0, below=1
    )
    photometric: str = setting(
        "l1", "distance between colours where loss=auto: l1, or mse, which leaves dssim out", choices=LOSS_KINDS
    )
    relative: bool = setting(True, "scale the scene's colours to fill [0, 1] for training, as in lit photographs")
    opacity: float = setting(0.0, "weight of the Gaussians' mean opacity", least=0)
    size: float = setting(
        0.0, "weight of the Gaussians' mean standard deviation, divided by the extent of the cameras", least=0
    )
    bend: float = setting(
        0.0, "weight of how far surfaces deviate from planes, away from edges in the picture", least=0
    )
    lr_means: float = setting(
        1.6e-4, "learning rate of the Gaussians' places, divided by the extent of the cameras", above=0
    )
    lr_scales: float = setting(5e-3, "learning rate of the logarithms of the Gaussians' scales", above=0)
    lr_quats: float = setting(1e-3, "learning rate of the Gaussians' quaternions", above=0)
    lr_sh0: float = setting(2.5e-3, "learning rate of the Gaussians' colours", above=0)
    lr_opacities: float = setting(5e-2, "learning rate of opacities before the sigmoid", above=0)
    lr_rest: float = setting(
        0.05, "learning rate of the colours' dependence on the direction, as a share of theirs", above=0
    )
    lr_final: float = setting(1.0, "factor that all learning rates but lr_means fall to by the last step", above=0)


@dataclass(frozen=True, kw_only=True)
class BARF2DConfig(Settings, section="backbone"):
    """Settings of BARF-2D. The defaults are BARF's, which the paper uses."""

    default_dataset = "planar"

    encoding: str = setting(
        "barf",
        "encoding of positions: none, naive (all frequencies from the first step) or barf (one frequency after "
        "another)",
        choices=("none", "naive", "barf"),
    )
    steps: int = setting(5000, "training steps", least=1)
    pixels: int | None = setting(None, "pixels a step, over all processes; null: all pixels of all patches", least=1)
    width: int = setting(256, "width of the network's hidden layers", least=1)
    depth: int = setting(4, "number of the network's hidden layers", least=1)
    frequencies: int = setting(8, "frequencies of the positions' encoding", least=1)
    lr: float = setting(1e-3, "learning rate of the network", above=0)
    lr_warp: float = setting(1e-3, "learning rate of the homographies", above=0)
    start: float = setting(
        0.0,
        "share of the training after which encoding=barf begins to bring the frequencies in",
        least=0,
        below=1,
        only=BARF,
    )
    end: float = setting(
        0.4, "share of the training after which encoding=barf has all frequencies in", above=0, most=1, only=BARF
    )
    shifts_until: float = setting(
        0.0,
        "share of the training in which patches are only shifted; afterwards they also turn, shear and tilt",
        least=0,
        most=1,
    )
    warp_decay: float = setting(
        0.0, "weight decay of a homography's parameters except the shift, until all frequencies are in", least=0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.end <= self.start:
            raise self.fault("end", f"a number from above backbone.start, {self.start}, to 1")
