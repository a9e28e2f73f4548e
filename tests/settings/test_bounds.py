"""What keys may be: the bounds that dataclasses give them, and how a value beyond is told."""

import math

import pytest

from ctm_plugin.appearance.settings import ExposureConfig
from ctm_plugin.backbones.settings import BARF2DConfig, NeRFConfig, NGPConfig, SplatConfig
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.settings import LightConfig, TransformTraining
from ctm_plugin.data.planar import PlanarConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import ConfigError

TABLE = {
    "backbone": [
        (BARF2DConfig, "one of none, naive, barf", {"encoding": "all"}),
        (BARF2DConfig, "an integer >= 1", {"steps": 0}),
        (BARF2DConfig, "a number > 0", {"lr": math.nan}),
        (BARF2DConfig, "an integer >= 1 or null", {"pixels": 0}),
        (BARF2DConfig, "a number in [0, 1]", {"shifts_until": 1.5}),
        (NeRFConfig, "one of bounded, forward, unbounded", {"geometry": "round"}),
        (NeRFConfig, "a layer from 1 to 7", {"skip": 8}),
        (NeRFConfig, "an integer >= 1", {"skip": 0, "fine_samples": 0}),
        (NeRFConfig, "an integer >= 3", {"coarse_samples": 2}),
        (NeRFConfig, "a number >= 0", {"density_noise": -1.0}),
        (NeRFConfig, "a number > 0", {"lr": math.nan}),
        (NGPConfig, "one of bounded, forward, unbounded", {"geometry": "round"}),
        (NGPConfig, "at least backbone.coarsest, 16", {"finest": 8}),
        (NGPConfig, "an integer, 4 to 28", {"log2_entries": 30}),
        (NGPConfig, "an integer, 1 to 8", {"degrees": 0}),
        (NGPConfig, "an integer >= 1", {"levels": 0}),
        (NGPConfig, f"one of {', '.join(str(n * n) for n in range(1, 17))}", {"rays_per_pixel": [2, 0]}),
        (NGPConfig, "a number in (0, 1)", {"threshold": 1.0}),
        (NGPConfig, "a number in [0, 1]", {"free_for_good": 1.5}),
        (NGPConfig, "a number in (0, 1]", {"occupancy_share": 1.5}),
        (NGPConfig, "a number > 0", {"lr_grid": math.nan}),
        (NGPConfig, "a number >= 0", {"distortion": -1.0, "occlusion": -1.0}),
        (SplatConfig, "an integer, 0 to 3", {"degree": [4, -1]}),
        (SplatConfig, "a number in [0, 1)", {"dssim": [1.0, -0.1]}),
        (SplatConfig, "one of mse, l1", {"photometric": "l2"}),
        (SplatConfig, "an integer >= 1", {"steps": 0, "views": 0, "first": 0, "grow_every": 0}),
        (SplatConfig, "an integer >= 0", {"grow_from": -1, "reset_every": -1}),
        (SplatConfig, "a number > 0", {"threshold": 0.0, "per_pixel": math.inf, "pruned": 0.0}),
        (SplatConfig, "a number > 0", {"lr_rest": 0.0, "lr_means": math.nan, "lr_final": 0.0}),
        (SplatConfig, "a number >= 0", {"opacity": -1.0, "size": -1.0, "bend": -1.0}),
    ],
    "ctm": [
        (TransformTraining, "a number > 0", {"lr": [0.0, math.nan, math.inf]}),
        (TransformTraining, "two numbers in [0, 1)", {"betas": (0.9, 1.0)}),
        (TransformTraining, "a number in (0, 1]", {"lr_decay": [0.0, 1.5]}),
        (TransformTraining, "an integer >= 0", {"pretrain_steps": -1}),
        (TransformTraining, "a number > 0 or null", {"pretrain_lr": 0.0}),
    ],
    "loss": [
        (Photometric, "one of mse, l1", {"kind": ["huber", "", "L2"]}),
        (Photometric, "a number >= 0", {"weight": [-0.1, math.nan, math.inf]}),
    ],
    "dataset": [
        (PlanarConfig, "an integer >= 8", {"patch": 0}),
        (PlanarConfig, "at least dataset.patch, 180", {"height": 100}),
        (PlanarConfig, "a number in [0, 2]", {"noise_h": -1, "noise_t": 3}),
        (PlanarConfig, "an integer >= 0", {"seed": -1}),
        (PlanarConfig, "a number in (0, 1]", {"exposure": 0}),
        (PlanarConfig, "a file, or one of astronaut, chelsea, coffee, rocket", {"image": ""}),
        (TransformsConfig, "a number in (0, 1]", {"exposure": [0.0, -1.0, 1.5, math.nan]}),
        (TransformsConfig, "a number in [1, 1000000]", {"downscale": [0.9, math.nan]}),
        (TransformsConfig, "an integer >= 1 or null", {"width": 0}),
        (TransformsConfig, "an integer >= 1", {"skip": 0}),
        (TransformsConfig, "one of black, white, random_matched, random", {"background": "pink"}),
        (TransformsConfig, "one of auto, bounded, forward, unbounded", {"geometry": "round"}),
        (TransformsConfig, "a number in [0, 1000000] or null", {"near": [-1.0, math.inf]}),
        (TransformsConfig, "the folder of a data set", {"root": ""}),
        (TransformsConfig, "an integer >= 2", {"test_every": 1}),
    ],
    "": [
        (LightConfig, "a number in [0.5, 2] or null", {"contrast": [0.4, 3.0]}),
        (LightConfig, "a number in [0, 2] or null", {"saturation": -0.1}),
    ],
    "appearance": [
        (ExposureConfig, "one of same, light, exif", {"start": "bright"}),
        (ExposureConfig, "a number > 0", {"lr": 0.0}),
        (ExposureConfig, "a number in (0, 1]", {"lr_decay": 2.0}),
    ],
}
"""By section: a dataclass, what a key may be, and values that it may not; a list has several."""
CASES = [
    (section, kind, expected, key, value)
    for section, rows in TABLE.items()
    for kind, expected, wrong in rows
    for key, values in wrong.items()
    for value in (values if isinstance(values, list) else [values])
]


@pytest.mark.parametrize(("section", "kind", "expected", "key", "value"), CASES)
def test_a_value_beyond_its_bounds(section, kind, expected, key, value):
    needed = {"root": "somewhere"} if kind is TransformsConfig else {}
    with pytest.raises(ConfigError) as caught:
        kind(**needed | {key: value})
    found = list(value) if isinstance(value, tuple) else value
    assert str(caught.value) == f"{f'{section}.' if section else ''}{key}: found {found!r}, expected {expected}"
