"""Planar alignment: patches of one picture under unknown homographies (BARF's 2D experiment; paper, Section 4.2)."""

from __future__ import annotations

import warnings
from importlib.resources import files
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ctm_plugin.color.light import brighten
from ctm_plugin.data.degrade import add_noise, view_generator
from ctm_plugin.data.readers.folders import RAW_HINT, RAW_SUFFIXES, require_file
from ctm_plugin.data.readers.images import read_picture, to_8_bits
from ctm_plugin.data.readers.layouts import layouts
from ctm_plugin.data.settings import PHOTOGRAPHS, PlanarSettings
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError, DataError
from ctm_plugin.rays.homography import patch_corners, pixel_grid, sl3_exp, to_pixels, warp
from ctm_plugin.scene.views import PlanarScene

PATCH_DIRECTIONS = torch.tensor([(0.0, 0.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)])
"""Directions that the patches are moved in: none for the middle one, a corner for each of the others."""
MAX_DRAWS = 10_000
"""Most homographies drawn before the magnitude is refused."""


class PlanarConfig(PlanarSettings):
    def load(self) -> PlanarScene:
        """Read the picture and cut patches out of it.

        Grey, 16-bit, palette and RGBA pictures are converted, transparency to black. A warning says so.

        Raises:
            DataError: the picture cannot be read, or is smaller than a patch.
            ConfigError: no homographies were found under which all corners of a patch lie inside.
        """
        path = photograph(self.image)
        image = fitted(_read(path, self), self.height, self.width)
        if self.exposure != 1:
            image = brighten(image, self.exposure, "hard")
        image = to_8_bits(image).float() / 255
        warps = draw_warps(self)
        clean = cut(image, warps, self.patch)
        noisy = [
            add_noise(patch, self.noise, view_generator(self.noise.seed, f"patch {index}"))
            for index, patch in enumerate(clean)
        ]
        return PlanarScene(Path(path).stem, image, warps, torch.stack(noisy), clean, float(self.exposure))


def photograph(image: str | Path) -> Path:
    """Find a photograph's file: one of scikit-image's by name, else the path; DataError: a folder, a raw picture."""
    if str(image) in PHOTOGRAPHS:
        return Path(str(files("skimage.data").joinpath(PHOTOGRAPHS[str(image)])))
    path = Path(image)
    if path.suffix.lower() in RAW_SUFFIXES:
        raise DataError(path, "a raw picture", RAW_HINT)
    if path.is_dir() and (there := layouts(path)):
        raise DataError(path, "a folder", f"a picture (dataset.image); dataset={there[0]} dataset.root={path} reads it")
    require_file(path, f"a picture, or one of {', '.join(PHOTOGRAPHS)} (dataset.image)")
    return path


def _read(path: Path, config: PlanarConfig) -> Float[Tensor, "h w 3"]:
    """Read a picture in colour; one warning names the conversions."""
    picture = read_picture(path)
    height, width, alpha, deep, *_ = picture.header
    if min(height, width) < config.patch:
        raise DataError(path, f"a picture of {width}x{height}", f"one at least as large as a patch, {config.patch}")
    done = []
    if alpha or deep:
        kind = f"{'more than 8' if deep else '8'} bits{' with transparency' if alpha else ''}"
        done.append(f"converted from {kind} to 8-bit colour, without transparency")
    if (height, width) != (config.height, config.width):
        done.append(f"scaled from {width}x{height} and cut to {config.width}x{config.height}")
    if done:
        warnings.warn(f"{path}: {', '.join(done)}", stacklevel=2)
    image = picture.image().clamp(0.0, 1.0)
    return image[..., :3] * image[..., 3:] if image.shape[-1] == 4 else image


def fitted(image: Float[Tensor, "h w 3"], height: int, width: int) -> Float[Tensor, "h2 w2 3"]:
    """Scale a picture, ratio kept, until it covers ``height`` x ``width``, and crop it equally at both edges."""
    if image.shape[:2] == (height, width):
        return image
    scale = max(height / image.shape[0], width / image.shape[1])
    size = [max(height, round(image.shape[0] * scale)), max(width, round(image.shape[1] * scale))]
    large = F.interpolate(image.permute(2, 0, 1)[None], size, mode="bilinear", antialias=True, align_corners=False)
    top, left = (size[0] - height) // 2, (size[1] - width) // 2
    return large[0, :, top : top + height, left : left + width].permute(1, 2, 0).clamp(0, 1).contiguous()


def draw_warps(config: PlanarConfig) -> Float[Tensor, "5 8"]:
    """Draw random homographies under which all corners of a patch lie inside the picture; the first is the identity.

    ``h ~ N(0, noise_h^2)``, (h1, h2) moved by ``noise_t`` towards a corner, drawn again until it fits.

    Raises:
        ConfigError: none was found.
    """
    corners = patch_corners(config.height, config.width, config.patch)
    warps = torch.zeros(len(PATCH_DIRECTIONS), 8)
    size = torch.tensor([config.width, config.height])
    for index in range(1, len(PATCH_DIRECTIONS)):
        drawn = config.noise_h * Draws(config.seed, index, stream="warps").normal(MAX_DRAWS, 8)
        drawn[:, :2] += config.noise_t * PATCH_DIRECTIONS[index]
        at = to_pixels(warp(corners, sl3_exp(drawn)), config.height, config.width)
        fits = ((at >= 0) & (at <= size)).all(-1).all(-1).nonzero()
        if not len(fits):
            expected = f"one that, moved by dataset.noise_t={config.noise_t}, fits into {config.width}x{config.height}"
            raise ConfigError("dataset.patch", config.patch, expected)
        warps[index] = drawn[fits[0, 0]]
    return warps


def cut(image: Float[Tensor, "h w 3"], warps: Float[Tensor, "n 8"], patch: int) -> Float[Tensor, "n p p 3"]:
    """Cut patches out of a picture under homographies, with bilinear interpolation, 0 outside the picture."""
    height, width, _ = image.shape
    grid = warp(pixel_grid(height, width, patch).flatten(0, 1), sl3_exp(warps)).unflatten(1, (patch, patch))
    grid = grid * max(height, width) / grid.new_tensor([width, height])
    pictures = image.permute(2, 0, 1).expand(len(warps), -1, -1, -1)
    return F.grid_sample(pictures, grid, align_corners=False).permute(0, 2, 3, 1).contiguous()
