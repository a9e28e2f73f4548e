"""The hash grid beside HashNeRF-pytorch's: the same rays, tables and time, steps taking turns.

``python benchmarks/ngp_peer.py PEER DATA_ROOT [--seconds 60] [--levels 16] [--entries 19] [--finest 512]``

PEER is a checkout of https://github.com/yashbhalgat/HashNeRF-pytorch, which is torch alone; DATA_ROOT a data set in
Blender layout. Each of the two has a process of its own, which rests while the other takes a step; whose steps have
taken less time comes next. The peer looks at 64 + 192 samples on every ray, at its own rates and losses but for its
total variation, which it applies to its first 1000 steps' tables and whose weight is 1e-6; ours looks at those that are
not in free space. Samples are looked up, and go through the density's network; some of ours twice.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import torch
from turns import SIDES, Turns, answer, view_psnr

from ctm_plugin.backbones.ngp import NGP
from ctm_plugin.compose.command_line import compose
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.settings import TrainerConfig
from ctm_plugin.scene.frustum import frustum_box


def our_module(args: argparse.Namespace) -> NGP:
    overrides = (
        f"dataset=blender dataset.root={args.data} dataset.downscale={args.downscale} dataset.background=white "
        f"backbone=ngp trainer=quick ctm=off backbone.rays={args.rays} backbone.steps={args.steps} "
        f"backbone.levels={args.levels} backbone.log2_entries={args.entries} backbone.finest={args.finest}"
    )
    return assemble(compose(*overrides.split())).backbone


class Ours:
    def __init__(self, args: argparse.Namespace, module: NGP):
        keep_memory()
        self.module, self.samples = module, 0
        self.bf16 = TrainerConfig(budget="quick", accelerator="cpu").numbers == "bf16-mixed"
        module.on_fit_start()
        self.optimizer = module.configure_optimizers()
        module.on_train_start()
        module.field.density.register_forward_pre_hook(self._count)

    def _count(self, network: torch.nn.Module, inputs: tuple[torch.Tensor]) -> None:
        self.samples += len(inputs[0])

    def step(self, step: int) -> int:
        module = self.module
        module.batches_seen, self.samples = step, 0
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            module.look_for_free_space(step)
            loss = module.training_step(None, step)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return self.samples

    def render(self, rays: Rays) -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            return self.module.render_rays(rays).latent


class Peer:
    """Its model and optimizer by its own ``create_nerf``, for its lego settings."""

    def __init__(self, args: argparse.Namespace, module: NGP):
        self.module, scene = module, module.scene
        sys.path.insert(0, args.peer)
        for name in ("load_llff", "load_deepvoxels", "load_blender", "load_scannet", "load_LINEMOD", "ray_utils"):
            sys.modules.setdefault(name, MagicMock())
        for name in ("tqdm", "imageio", "matplotlib", "matplotlib.pyplot"):
            sys.modules.setdefault(name, MagicMock())
        made = torch.tensor
        with patch("torch.tensor", lambda *values, device=None, **rest: made(*values, **rest)):  # it names a GPU
            import run_nerf
        self.peer, run_nerf.os = run_nerf, MagicMock()  # create_nerf looks for checkpoints
        box = frustum_box(scene.train, scene.near, scene.far)
        settings = SimpleNamespace(
            multires=10, multires_views=4, i_embed=1, i_embed_views=2, use_viewdirs=True, N_importance=128,
            N_samples=64, netdepth=8, netwidth=256, netdepth_fine=8, netwidth_fine=256, netchunk=1024 * 64, lrate=1e-2,
            basedir="", expname="", ft_path=None, no_reload=True, perturb=1.0, white_bkgd=True, raw_noise_std=0.0,
            dataset_type="blender", no_ndc=True, lindisp=False, bounding_box=(box[0], box[1]),
            log2_hashmap_size=args.entries, finest_res=args.finest,
        )  # fmt: skip
        torch.manual_seed(0)
        self.kwargs, _, _, _, self.optimizer = run_nerf.create_nerf(settings)
        self.kwargs |= {"near": scene.near, "far": scene.far}

    def query(self, rays: Rays, **changes):
        together = torch.stack([rays.origins, rays.directions])
        return self.peer.render(1, 1, None, chunk=1024 * 32, rays=together, **(self.kwargs | changes))

    def step(self, step: int) -> int:
        batch = self.module.draw(self.module.draws(step))
        rgb, _, _, extras = self.query(batch.rays)
        self.optimizer.zero_grad()
        loss = self.peer.img2mse(rgb, batch.rgb) + self.peer.img2mse(extras["rgb0"], batch.rgb)
        loss = loss + 1e-10 * (extras["sparsity_loss"].sum() + extras["sparsity_loss0"].sum())
        loss.backward()
        self.optimizer.step()
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-2 * 0.1 ** ((step + 1) / 10_000)
        return len(rgb) * (64 + 192)

    @torch.no_grad()
    def render(self, rays: Rays) -> torch.Tensor:
        chunks = [rays[start : start + 1024] for start in range(0, len(rays.origins), 1024)]
        return torch.cat([self.query(chunk, perturb=0.0)[0] for chunk in chunks])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("data", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each side's steps")
    parser.add_argument("--steps", type=int, default=2000, help="of our schedule")
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--levels", type=int, default=16, help="ours; the peer has 16")
    parser.add_argument("--entries", type=int, default=19)
    parser.add_argument("--finest", type=int, default=512)
    parser.add_argument("--views", type=int, default=3, help="test views to score")
    parser.add_argument("--work", choices=SIDES, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        side = {"ours": Ours, "peer": Peer}[args.work](args, our_module(args))
        return answer(args.work, side.step, lambda: view_psnr(side.module, side.render, args.views))

    turns, spent = Turns(), dict.fromkeys(SIDES, 0.0)
    while min(spent.values()) < args.seconds:
        name = min(spent, key=spent.get)
        spent[name] += turns.turn(name, len(turns.found[name]))
    scores = turns.scores()
    turns.close()
    print(f"{args.rays} rays, 2^{args.entries} rows, {torch.get_num_threads()} threads, {args.seconds:.0f} s each")
    print(f"{'':6}{'steps':>8}{'ms a step':>10}{'samples/ms':>12}{'peak GiB':>10}{'test PSNR':>11}")
    for name, rows in turns.found.items():
        rate = sum(samples for *_, samples in rows) / spent[name] / 1e3
        line = f"{name:6}{len(rows):8}{turns.seconds(name) * 1e3:10.1f}{rate:12.0f}{turns.memory(name):10.2f}"
        print(f"{line}{scores[name]:11.2f}")


if __name__ == "__main__":
    main()
