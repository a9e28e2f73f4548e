"""How good a transform is before the field trains: cycle errors, and what happens to blends of colours.

``python benchmarks/transform.py OVERRIDES...``, as on the command line of ``ctm_plugin``; all figures in dB.
"""

from __future__ import annotations

import sys

import lightning as L
import torch
from torch import Tensor

from ctm_plugin.compose.command_line import compose
from ctm_plugin.draws import Draws
from ctm_plugin.runs.assemble import assemble

PAIRS = 20000


def decibel(a: Tensor, b: Tensor) -> str:
    return f"{-10 * torch.log10((a - b).square().mean()):.1f}"


def main() -> None:
    parts = assemble(compose(*sys.argv[1:]))
    # One step: what comes before it is what is looked at.
    L.Trainer(
        max_steps=1, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, accelerator="cpu",
    ).fit(parts.backbone)  # fmt: skip
    field, ctm, draws = parts.backbone, parts.backbone.transform, Draws(1, 0)
    with torch.no_grad():
        seen, other = field.scene_colors(draws, PAIRS), field.scene_colors(draws, PAIRS)
        random, latent, share = draws.uniform(PAIRS, 3), draws.uniform(PAIRS, ctm.channels), draws.uniform(PAIRS, 1)
        behind = field.constant_background().expand_as(seen)
        blends = {}
        for name, second in (("training colours", other), ("the background", behind)):
            mixed = ctm.decode(torch.lerp(ctm.encode(seen), ctm.encode(second), share))
            blends[name] = decibel(mixed, torch.lerp(seen, second, share))
        print("cycle of training colours", decibel(ctm.decode(ctm.encode(seen)), seen))
        print("cycle of random colours", decibel(ctm.decode(ctm.encode(random)), random))
        print("cycle of random latents", decibel(ctm.encode(ctm.decode(latent)), latent))
        for name, figure in blends.items():
            print(f"blends with {name}", figure)


if __name__ == "__main__":
    main()
