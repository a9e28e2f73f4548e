"""Run directories without the training."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from ctm_plugin.runs.rundir import save_config


def seeded(composed: Callable[..., dict[str, Any]], *arguments: str) -> dict[str, Any]:
    """What the arguments come to, composed once for all seeds: only seeds depend on it."""
    config = composed(*(each for each in arguments if not each.startswith("seed=")))
    for each in arguments:
        if each.startswith("seed="):
            for section in (config, config["dataset"]):
                section |= {"seed": int(each.removeprefix("seed="))} if "seed" in section else {}
    return config


@pytest.fixture
def made(tmp_path, composed) -> Callable[..., Path]:
    """``made(*arguments, **metrics)``: a finished run of that configuration with these scores, its folder."""
    count = 0

    def make(*arguments: str, views: bool = False, **metrics: Any) -> Path:
        nonlocal count
        count += 1
        folder = tmp_path / "runs" / f"{count:03d}"
        usual = () if any(each.startswith("ctm=") for each in arguments) else ("ctm=quick",)
        config = seeded(composed, "dataset=still_life", *usual, *arguments)
        save_config(folder, config)
        scores = {"psnr": 30.0, "ssim": 0.9, "lpips": 0.1, "converged": True, "steps": 1000}
        scores |= {"protocol": "still_life, 2 test views", "dataset": "still_life", "seed": config["seed"]} | metrics
        if views:
            scores["per_image"] = [{"name": "r_0"}, {"name": "r_1"}]
            for index, kind in enumerate(("lit", "dark", "latent", "depth", "photo")):
                picture = np.random.default_rng(count + index).integers(0, 255, (16, 24, 3), dtype=np.uint8)
                (folder / kind).mkdir(exist_ok=True)
                iio.imwrite(folder / kind / "r_1.png", picture)
        (folder / "metrics.json").write_text(json.dumps(scores))
        return folder

    return make


@pytest.fixture
def table4(made):
    """Runs of Table 4, two seeds."""
    for seed in (0, 1):
        made("ctm=off", f"seed={seed}", psnr=30.0 + seed, views=True)
        made(f"seed={seed}", psnr=33.0 + seed, views=True)
        for term in ("img", "rand"):
            folder = made(f"seed={seed}", f"ctm.weights.{term}=0", psnr=32.0 + seed, views=True)
    return folder.parent
