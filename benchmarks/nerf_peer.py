"""NeRF's training step beside nerf-pytorch's: the same rays, samples, sizes and rates, steps taking turns.

``python benchmarks/nerf_peer.py PEER DATA_ROOT [--downscale 4] [--steps 6] [--rays 1024] [--views 1]``

PEER is a checkout of https://github.com/yenchenlin/nerf-pytorch, DATA_ROOT a data set in Blender layout. Each of the
two has a process of its own, which rests while the other takes a step: times, memory and allocators stay apart. Both
start from the same weights; ``--init own`` lets each start as it does by itself.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import torch
from turns import Turns, answer, view_psnr

from ctm_plugin.backbones.nerf import NeRF
from ctm_plugin.backbones.nerf_field import NeRFField
from ctm_plugin.compose.command_line import compose
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.runs.assemble import assemble


def our_module(args: argparse.Namespace) -> NeRF:
    overrides = (
        f"dataset=blender dataset.root={args.data} dataset.downscale={args.downscale} "
        f"backbone=nerf trainer=paper ctm=off backbone.rays={args.rays}"
    )
    config = compose(*overrides.split())
    module = assemble(config).backbone
    module.pool = module.middle_pixels()
    return module


def peer_parts(path: str) -> tuple[SimpleNamespace, dict, torch.optim.Optimizer]:
    """Its module ``run_nerf``, without readers of data, and what its ``create_nerf`` gives for its lego settings."""
    sys.path.insert(0, path)
    for name in ("load_llff", "load_deepvoxels", "load_blender", "load_LINEMOD", "cv2", "tqdm", "imageio"):
        sys.modules.setdefault(name, MagicMock())
    import run_nerf

    run_nerf.os = MagicMock()  # create_nerf looks for checkpoints
    settings = SimpleNamespace(
        multires=10, multires_views=4, i_embed=0, use_viewdirs=True, N_importance=128, N_samples=64, netdepth=8,
        netwidth=256, netdepth_fine=8, netwidth_fine=256, netchunk=1024 * 64, lrate=5e-4, basedir="", expname="",
        ft_path=None, no_reload=True, perturb=1.0, white_bkgd=True, raw_noise_std=0.0, dataset_type="blender",
        no_ndc=True, lindisp=False,
    )  # fmt: skip
    torch.manual_seed(0)
    kwargs, _, _, _, optimizer = run_nerf.create_nerf(settings)
    return run_nerf, kwargs, optimizer


def copy_weights(field: NeRFField, peer: torch.nn.Module) -> None:
    """The peer's embedding takes the sine and cosine of each frequency in turn, ours all sines first."""

    def order(frequencies: int) -> torch.Tensor:
        waves = torch.arange(6 * frequencies).view(frequencies, 2, 3).transpose(0, 1).flatten()
        return torch.cat([torch.arange(3), 3 + waves])

    position, direction = order(10), order(4)
    layers = [*zip(field.trunk, peer.pts_linears, strict=True), (field.density, peer.alpha_linear)]
    layers += [(field.feature, peer.feature_linear), (field.view, peer.views_linears[0])]
    layers += [(field.color, peer.rgb_linear)]
    with torch.no_grad():
        for ours, theirs in layers:
            ours.weight.copy_(theirs.weight)
            ours.bias.copy_(theirs.bias)
        for index in (0, field.skip):
            field.trunk[index].weight[:, :63] = peer.pts_linears[index].weight[:, position]
        field.view.weight[:, 256:] = peer.views_linears[0].weight[:, 256 + direction]


class Ours:
    def __init__(self, args: argparse.Namespace, module: NeRF):
        keep_memory()
        self.module, self.bf16 = module, args.precision == "bf16-mixed"
        if args.init == "same":
            _, kwargs, _ = peer_parts(args.peer)
            copy_weights(module.coarse, kwargs["network_fn"])
            copy_weights(module.fine, kwargs["network_fine"])
        self.optimizer = module.configure_optimizers()

    def step(self, step: int) -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=self.bf16):
            loss = self.module.training_step(None, step)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    def render(self, rays) -> torch.Tensor:
        return self.module.render_rays(rays).latent


class Peer:
    def __init__(self, args: argparse.Namespace, module: NeRF):
        self.module = module
        self.peer, self.kwargs, self.optimizer = peer_parts(args.peer)
        self.kwargs |= {"near": module.scene.near, "far": module.scene.far}

    def query(self, rays, **changes):
        together = torch.stack([rays.origins, rays.directions])
        return self.peer.render(1, 1, None, chunk=1024 * 32, rays=together, **(self.kwargs | changes))

    def step(self, step: int) -> None:
        batch = self.module.draw(self.module.draws(step))
        rgb, _, _, extras = self.query(batch.rays)
        self.optimizer.zero_grad()
        loss = self.peer.img2mse(rgb, batch.rgb) + self.peer.img2mse(extras["rgb0"], batch.rgb)
        loss.backward()
        self.optimizer.step()

    @torch.no_grad()
    def render(self, rays) -> torch.Tensor:
        chunks = [rays[start : start + 1024] for start in range(0, len(rays.origins), 1024)]
        return torch.cat([self.query(chunk, perturb=0.0)[0] for chunk in chunks])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("data")
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--rays", type=int, default=1024)
    parser.add_argument("--views", type=int, default=1, help="test views to score, at least 1")
    parser.add_argument("--init", choices=("same", "own"), default="same")
    parser.add_argument("--precision", choices=("32-true", "bf16-mixed"), default="32-true", help="ours")
    parser.add_argument("--work", choices=("ours", "peer"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        side = {"ours": Ours, "peer": Peer}[args.work](args, our_module(args))
        return answer(args.work, side.step, lambda: view_psnr(side.module, side.render, args.views))

    turns = Turns()
    for step in range(args.steps):
        turns.step(step)
    scores = turns.scores()
    turns.close()

    print(f"{args.rays} rays, 64 + 128 samples, 8 x 256 twice, ours {args.precision}")
    print(f"{torch.get_num_threads()} threads, {args.steps} steps, start: {args.init}")
    print(f"{'':6}{'s a step':>10}{'rays/s':>10}{'peak GiB':>10}{'PSNR':>8}")
    for name, score in scores.items():
        seconds = turns.seconds(name)
        print(f"{name:6}{seconds:10.2f}{args.rays / seconds:10.0f}{turns.memory(name):10.2f}{score:8.2f}")
    print(turns.ratios())


if __name__ == "__main__":
    main()
