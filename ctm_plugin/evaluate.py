"""Render and score the test views; as a command, of a finished or interrupted run from its checkpoint alone.

``python -m ctm_plugin.evaluate RUN_DIR``
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from rich.progress import track
from torch import Tensor

from ctm_plugin.allocator import keep_memory
from ctm_plugin.assemble import Config, Parts, assemble, restore
from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.backbones.radiance import RadianceBackbone
from ctm_plugin.console import error_console, print_summary
from ctm_plugin.data.scene import composite
from ctm_plugin.errors import CTMError
from ctm_plugin.files import write_json
from ctm_plugin.metrics.enhance import enhancement_gain, lift
from ctm_plugin.metrics.lpips import LPIPS
from ctm_plugin.metrics.lpips_weights import load_lpips
from ctm_plugin.metrics.precision import full_float32
from ctm_plugin.metrics.summary import summarize
from ctm_plugin.pictures import depth_picture, latent_picture, write_png
from ctm_plugin.planar import score_planar
from ctm_plugin.products import fast_products
from ctm_plugin.provenance import code_version, fingerprint, versions
from ctm_plugin.rundir import LAST, load_checkpoint, load_config


def score(module: Backbone, config: Config, folder: Path, lpips: tuple[LPIPS | None, str]) -> dict[str, Any]:
    """Score a trained backbone and write its pictures into ``folder``, as suits its kind.

    ``lpips`` is what :func:`ctm_plugin.metrics.lpips_weights.load_lpips` returned.

    """
    if isinstance(module, RadianceBackbone):
        return score_views(module, config, folder, lpips)
    if isinstance(module, BARF2D):
        with full_float32(module.device):
            return score_planar(module, folder)
    return module.scores(folder)


def score_views(
    module: RadianceBackbone, config: Config, folder: Path, lpips: tuple[LPIPS | None, str]
) -> dict[str, Any]:
    """Render every test view into ``folder`` and score the decoded colours against the pictures as captured.

    Writes ``NAME.png``, ``NAME_depth.png``, ``NAME_latent.png`` and, for dark scenes, ``NAME_lifted.png``.

    Returns:
        See :func:`ctm_plugin.metrics.summary.summarize`, with ``protocol``.
    """
    scene, views = module.scene, module.scene.test
    targets, gain = targets_and_gain(module)
    module.eval()
    rendered, depths = [], []
    console = error_console()
    hidden = not console.is_terminal
    with full_float32(module.device):
        for index in track(range(len(views)), "test views", console=console, disable=hidden, transient=True):
            view = {name: value.float().cpu() for name, value in module.render_view(views, index).items()}
            rendered.append(view["rgb"])
            depths.append(view["depth"])
            name = folder / views.names[index]
            write_png(name.with_name(f"{name.name}.png"), view["rgb"])
            write_png(name.with_name(f"{name.name}_depth.png"), depth_picture(view["depth"], scene.near, scene.far))
            write_png(name.with_name(f"{name.name}_latent.png"), latent_picture(view["latent"]))
            if gain > 1:
                write_png(name.with_name(f"{name.name}_lifted.png"), lift(view["rgb"], gain))
        true_depths = None if views.depth is None else list(views.depth)
        result = summarize(views.names, rendered, targets, scene.exposure, depths, true_depths, lpips=lpips)
    return result | {"protocol": protocol(config, module)}


def targets_and_gain(module: RadianceBackbone) -> tuple[list[Float[Tensor, "h w 3"]], float]:
    """The test views over the constant background, on the CPU, and what lifts them (:func:`enhancement_gain`)."""
    background = module.constant_background().cpu()
    targets = [composite(image, background) for image in module.scene.test.images]
    return targets, enhancement_gain(targets, module.scene.exposure)


def protocol(config: Config, module: RadianceBackbone) -> str:
    """What two runs must share for their scores to stand in one cell of a table."""
    views, dataset = module.scene.test, config["dataset"]
    return (
        f"{module.scene.name}, {len(views)} test views {views.width}x{views.height}, exposure {dataset['exposure']}, "
        f"{'white' if module.scene.background == 'white' else 'black'} behind, float RGB clipped to [0, 1], "
        f"PSNR and SSIM per image then mean"
    )


def run_figures(module: Backbone, config: Config, steps: int, seconds: float, peak_memory_mb: float) -> dict[str, Any]:
    """What ``metrics.json`` says of a run beside its scores."""
    return {
        "steps": steps,
        "train_seconds": seconds,
        "rays_per_second": module.batches_seen * module.rays / seconds if seconds else None,
        "peak_memory_mb": peak_memory_mb,
        "backbone": config["backbone"]["name"],
        "ctm": config["ctm"].get("preset", config["ctm"]["name"]),
        "color_space": config["color_space"]["name"],
        "precision": config["trainer"]["precision"],
        "dataset": module.scene.name,
        "seed": config["seed"],
        "version": code_version(),
        "versions": versions(),
        "data": fingerprint(getattr(module, "scene", None)),
    }


def load_run(run: Path) -> tuple[Parts, dict[str, Any], dict[str, Any]]:
    """A run as it was at its last checkpoint: parts with weights, configuration, step and callbacks' states.

    Raises:
        CTMError: the folder is no run, or its checkpoint cannot be used.
    """
    config = load_config(run)
    checkpoint = load_checkpoint(run, config)
    parts = assemble(config)
    restore(parts, checkpoint, run / LAST)
    parts.backbone.to("cuda" if torch.cuda.is_available() and parts.trainer.accelerator != "cpu" else "cpu")
    # The rest of it, weights and moments, would be held as long.
    return parts, config, {name: checkpoint[name] for name in ("global_step", "callbacks")}


def evaluate(run: Path) -> dict[str, Any]:
    """Score a run again from its configuration and checkpoint; writes ``RUN/evaluation/``.

    Raises:
        CTMError: if the folder is no run, or its checkpoint cannot be used.
    """
    parts, config, checkpoint = load_run(run)
    lpips = load_lpips(parts.metrics.lpips_weights, parts.metrics.lpips_net)
    figures = run_figures(parts.backbone, config, checkpoint["global_step"], **checkpoint["callbacks"]["Stopwatch"])
    (run / "evaluation").mkdir(exist_ok=True)
    with fast_products(parts.backbone.device):
        result = score(parts.backbone, config, run / "evaluation", lpips) | figures
    write_json(run / "evaluation" / "metrics.json", result)
    return result


def main(arguments: list[str] | None = None) -> int:
    """Command line: one run directory."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print("usage: python -m ctm_plugin.evaluate RUN_DIR", file=sys.stderr)
        return 2
    keep_memory()
    try:
        run = Path(arguments[0])
        print_summary(evaluate(run), run / "evaluation")
    except CTMError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
