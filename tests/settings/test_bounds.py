"""What keys may be: the bounds that dataclasses give them, and how a value beyond is told."""

import math

import pytest

from ctm_plugin.backbones.settings import BARF2DConfig, NeRFConfig, NGPConfig, SplatConfig
from ctm_plugin.color.settings import LightConfig, TransformTraining
from ctm_plugin.data.planar import PlanarConfig
from ctm_plugin.data.transforms import TransformsConfig
from ctm_plugin.errors import ConfigError

TABLE = {
    "backbone": [
        (BARF2DConfig, "one of none, naive, barf", {"encoding": "all"}),
        (BARF2DConfig, "an integer >= 1 or null", {"pixels": 0}),
        (NeRFConfig, "a layer from 1 to 7", {"skip": 8}),
        (NGPConfig, "at least backbone.coarsest, 16", {"finest": 8}),
        (NGPConfig, "an integer, 4 to 28", {"log2_entries": 30}),
        (NGPConfig, f"one of {', '.join(str(n * n) for n in range(1, 17))}", {"rays_per_pixel": [2, 0]}),
        (NGPConfig, "a number in (0, 1)", {"threshold": 1.0}),
        (NGPConfig, "a number >= 0", {"distortion": -1.0}),
        (SplatConfig, "a number in [0, 1)", {"dssim": [1.0, -0.1]}),
        (SplatConfig, "an integer >= 0", {"grow_from": -1}),
        (SplatConfig, "a number > 0", {"per_pixel": math.inf, "lr_means": math.nan}),
    ],
    "ctm": [
        (TransformTraining, "two numbers in [0, 1)", {"betas": (0.9, 1.0)}),
        (TransformTraining, "a number in (0, 1]", {"lr_decay": [0.0, 1.5]}),
        (TransformTraining, "a number > 0 or null", {"pretrain_lr": 0.0}),
    ],
    "dataset": [
        (PlanarConfig, "at least dataset.patch, 180", {"height": 100}),
        (PlanarConfig, "a file, or one of astronaut, chelsea, coffee, rocket", {"image": ""}),
        (TransformsConfig, "a number in [1, 1000000]", {"downscale": [0.9, math.nan]}),
        (TransformsConfig, "a number in [0, 1000000] or null", {"near": [-1.0, math.inf]}),
        (TransformsConfig, "the folder of a data set", {"root": ""}),
    ],
    "": [(LightConfig, "a number in [0.5, 2] or null", {"contrast": [0.4, 3.0]})],
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
