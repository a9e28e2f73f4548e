"""DVGO's fine stage beside the first release of DirectVoxGO: the same coarse field, box, rays and rates, in turns.

``python benchmarks/dvgo_peer.py PEER DATA_ROOT [--steps 300] [--voxels 262144] [--rays 1024] [--alike]``

PEER is a checkout of https://github.com/sunset1995/DirectVoxGO at c61be29, which is torch alone; DATA_ROOT a data set
in Blender layout. Each of the two has a process of its own, which rests while the other takes a step. Both begin the
fine stage, at its full grid, from the coarse stage that ours has run; the free space that this found stays as it is.

Two things of the first release are not in the paper's settings, as later releases have them: Adam moves voxels without
gradient too, and the position is encoded for the network. ``--alike`` gives ours that Adam and takes that encoding from
theirs.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import lightning as L
import torch
import torch.nn.functional as F
from torch.optim import Adam
from turns import Turns, answer, view_psnr

from ctm_plugin.backbones.dvgo import DVGO
from ctm_plugin.backbones.voxels import VoxelField
from ctm_plugin.compose.command_line import compose
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.draws import Draws
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import as_volume
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.settings import TrainerConfig
from ctm_plugin.scene.views import composite

COARSE_STEPS = 1000
AUTO = TrainerConfig(budget="quick", accelerator="cpu").numbers


class _KeepCoarse(L.Callback):
    """Callbacks come before the module's own hook, which replaces the field."""

    def on_train_batch_start(self, trainer: L.Trainer, module: DVGO, *_) -> None:
        if module.global_step == module.fine_start:
            self.field = module.field


def at_fine_stage(args: argparse.Namespace) -> tuple[DVGO, VoxelField]:
    """Ours, one step into the fine stage, and the coarse stage's field."""
    overrides = (
        f"dataset=blender dataset.root={args.data} dataset.downscale={args.downscale} dataset.background=white "
        f"backbone=dvgo trainer=quick ctm=off backbone.coarse=true backbone.coarse_steps={COARSE_STEPS} "
        f"backbone.rays={args.rays} backbone.voxels={args.voxels} backbone.grow=[] backbone.threshold=1e-4 "
        "backbone.relative=false backbone.occlusion=0 "  # the peer's losses: others leave ours more samples
        "backbone.coarse_entropy=0.01 backbone.coarse_lr_grid=0.1 backbone.lr_grid=0.1 backbone.lr_mlp=0.001"
    )
    module = assemble(compose(*overrides.split())).backbone
    keep = _KeepCoarse()
    trainer = L.Trainer(
        accelerator="cpu", max_steps=COARSE_STEPS + 1, precision=args.precision, callbacks=[keep], logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module)
    module.trainer = None
    return module, keep.field


class Ours:
    def __init__(self, args: argparse.Namespace, module: DVGO, coarse: VoxelField):
        self.module, self.bf16 = module, args.precision == "bf16-mixed"
        if args.alike:
            module.field.sparse = False
            module.grid_optimizer = lambda: Adam(
                [module.field.density, module.field.features], module.config.lr_grid, module.betas, fused=True
            )
        self.optimizer = module.configure_optimizers()

    def step(self, step: int) -> float:
        self.module.batches_seen = step
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            loss = self.module.training_step(None, step)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return self.module.terms["color"].item()

    def render(self, rays: Rays) -> torch.Tensor:
        return self.module.render_rays(rays).latent


class Peer:
    """Its model with its own default settings, its losses and its optimizer; rays that may meet something are ours."""

    def __init__(self, args: argparse.Namespace, module: DVGO, coarse: VoxelField):
        sys.path.insert(0, args.peer)
        from lib import dvgo, utils

        self.module, config = module, module.config
        low, high = module.field.grid.aabb.tolist()
        sizes = {"num_voxels": args.voxels, "num_voxels_base": args.voxels}
        with tempfile.TemporaryDirectory() as folder:
            self.model = dvgo.DirectVoxGO(
                low, high, **sizes, alpha_init=module.alpha_init, fast_color_thres=config.threshold, rgbnet_dim=12,
                posbase_pe=0 if args.alike else 5, rgbnet_direct=True, mask_cache_thres=1e-3,
                mask_cache_path=self._saved(coarse, Path(folder)),
            )  # fmt: skip
        rates = {"lrate_density": config.lr_grid, "lrate_k0": config.lr_grid, "lrate_rgbnet": config.lr_mlp}
        self.optimizer = utils.create_optimizer_or_freeze_model(
            self.model, Settings(lrate_decay=20, **rates), global_step=0
        )
        scene, white = module.scene, module.constant_background()
        self.render_kwargs = {"near": scene.near, "far": scene.far, "bg": 1, "stepsize": config.step_size}
        pool = torch.arange(len(module.pixels)) if module.pool is None else module.pool.long()
        self.rays, self.rgb = module.training_rays(pool), composite(module.pixels[pool], white)

    @staticmethod
    def _saved(coarse: VoxelField, folder: Path) -> str:
        """The coarse field as the peer's own checkpoint."""
        low, high = coarse.grid.aabb.tolist()
        about = {"xyz_min": low, "xyz_max": high, "act_shift": coarse.vertex_shift}
        about["voxel_size_ratio"] = coarse.grid.voxel / coarse.space.measure
        density = as_volume(coarse.density.detach(), coarse.grid.shape)[None]
        path = folder / "coarse.tar"
        torch.save({"MaskCache_kwargs": about, "model_state_dict": {"density": density}}, path)
        return str(path)

    def step(self, step: int) -> float:
        config = self.module.config
        pick = Draws(self.module.seed, step).integers(len(self.rgb), config.rays)
        rays, target = self.rays[pick], self.rgb[pick]
        found = self.model(rays.origins, rays.directions, rays.directions, global_step=step, **self.render_kwargs)
        self.optimizer.zero_grad(set_to_none=True)
        color = F.mse_loss(found["rgb_marched"], target)
        share = found["alphainv_cum"][..., -1].clamp(1e-6, 1 - 1e-6)
        entropy = -(share * torch.log(share) + (1 - share) * torch.log(1 - share)).mean()
        error = (found["raw_rgb"] - target.unsqueeze(-2)).pow(2).sum(-1)
        point = (error * found["weights"].detach()).sum(-1).mean()
        (color + self.module.entropy * entropy + self.module.point * point).backward()
        self.optimizer.step()
        return color.item()

    @torch.no_grad()
    def render(self, rays: Rays) -> torch.Tensor:
        parts = [rays[start : start + 4096] for start in range(0, len(rays.origins), 4096)]
        found = [self.model(part.origins, part.directions, part.directions, **self.render_kwargs) for part in parts]
        return torch.cat([part["rgb_marched"] for part in found])


class Settings(SimpleNamespace):
    """A namespace that lists its keys, as the peer's code wants."""

    def keys(self):
        return vars(self).keys()


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("data", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--voxels", type=int, default=64**3)
    parser.add_argument("--precision", choices=("32-true", "bf16-mixed"), default=AUTO, help="ours")
    parser.add_argument("--alike", action="store_true", help="compare the same method")
    parser.add_argument("--work", choices=("ours", "peer"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        keep_memory() if args.work == "ours" else None
        side = {"ours": Ours, "peer": Peer}[args.work](args, *at_fine_stage(args))
        return answer(args.work, side.step, lambda: view_psnr(side.module, side.render))

    turns = Turns()
    for step in range(args.steps):
        turns.step(step)
    scores = turns.scores()
    turns.close()
    print(f"{args.rays} rays, {args.voxels} voxels, ours {args.precision}, {torch.get_num_threads()} threads")
    print(f"{'':6}{'ms a step':>10}{'peak GiB':>10}{'test PSNR':>12}")
    for name in turns.found:
        print(f"{name:6}{turns.seconds(name) * 1e3:10.1f}{turns.memory(name):10.2f}{scores[name]:12.2f}")
    print(turns.ratios())


if __name__ == "__main__":
    main()
