"""What CTM adds to a training step: the same DVGO, the same rays, with and without it, steps interleaved, medians.

The field's learning rates are 0 here, so that both have the same samples throughout: what is compared is the step.

``python benchmarks/ctm_step.py [DATA_ROOT] [DOWNSCALE]``: a data set in Blender layout, else the lit still life.
"""

from __future__ import annotations

import copy
import statistics
import sys
import time
from pathlib import Path

import lightning as L
import torch
from hydra import compose, initialize_config_dir

from ctm_plugin.allocator import keep_memory
from ctm_plugin.assemble import assemble
from ctm_plugin.cli import conf_dir, resolved
from ctm_plugin.color.ctm import CTM, CTMConfig
from ctm_plugin.color.transform import ColorSpace
from ctm_plugin.draws import Draws
from ctm_plugin.products import fast_products

WARM_UP, STEPS = 800, 200


def pairs(times: list[float]) -> zip:
    """Pairs of one step as the first and one as the second."""
    return zip(times[::2], times[1::2], strict=True)


def main() -> None:
    keep_memory()
    data = [f"dataset=blender dataset.root={sys.argv[1]} dataset.downscale={sys.argv[2]}"] if len(sys.argv) > 2 else []
    overrides = " ".join(data or ["dataset.light=lit dataset.background=black"]).split()
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        config = resolved(compose("config", ["ctm=off", f"backbone.steps={WARM_UP}", *overrides]))
    parts = assemble(config)
    precision = parts.trainer.numbers
    trainer = L.Trainer(
        max_steps=parts.backbone.total_steps, precision=precision, callbacks=[parts.attach], logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(parts.backbone)
    parts.backbone.trainer = None

    on = CTM(CTMConfig(init="range"))
    on.begin(parts.backbone.scene_colors(Draws(0, 0), 1 << 15))
    runs = {}
    for name, transform in (("off", ColorSpace("rgb")), ("on", on)):
        module = copy.deepcopy(parts.backbone)
        module.transform = transform.to(module.device)
        if name == "on":
            adam = torch.optim.Adam(on.parameters(), 5e-4, fused=True)
            module.transform_optimizer = lambda transform, adam=adam: (adam, lambda step: 1.0)
        optimizers = module.configure_optimizers()
        for member in module.field_optimizers():
            for group in optimizers.members[member].param_groups:
                group["lr"] = 0.0
        runs[name] = (module, optimizers, [])

    bf16 = precision == "bf16-mixed"
    for step in range(STEPS):
        # Whoever comes first with new rays pays for memory of new sizes: they take turns.
        for module, optimizer, times in list(runs.values())[:: 1 if step % 2 else -1]:
            start = time.perf_counter()
            with torch.autocast(module.device.type, torch.bfloat16, enabled=bf16):
                loss = module.training_step(None, 0)["loss"]
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            if module.device.type == "cuda":
                torch.cuda.synchronize()
            times.append(time.perf_counter() - start)
    off, on = (statistics.median(map(sum, pairs(times[10:]))) / 2 * 1e3 for _, _, times in runs.values())
    scene = Path(sys.argv[1]).name if data else "still_life_lit"
    print(f"{scene}, {precision}, {torch.get_num_threads()} threads, {module.device}")
    print(f"off {off:.2f} ms, on {on:.2f} ms a step, ratio {on / off:.3f}")


if __name__ == "__main__":
    with fast_products(torch.device("cuda" if torch.cuda.is_available() else "cpu")):
        main()
