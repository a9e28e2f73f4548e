"""BARF-2D's training step beside the authors' own: the same picture, homographies, weights and rates.

``python benchmarks/barf_peer.py PEER [--steps 6] [--precision 32-true] [--setting KEY=VALUE ...]``

PEER is a checkout of https://github.com/chenhsuanlin/bundle-adjusting-NeRF. Each of the two has a process of its own,
which rests while the other takes a step: times, memory and allocators stay apart. Both start from the same weights, so
that their losses can be compared step by step. With many steps, ``--every N`` compares warping errors along the way.
"""

from __future__ import annotations

import argparse
import sys
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import torch
from turns import Turns, answer

from ctm_plugin.backbones.barf2d import BARF2D
from ctm_plugin.compose.command_line import compose
from ctm_plugin.cpu.allocator import keep_memory
from ctm_plugin.runs.assemble import assemble


def our_module(args: argparse.Namespace) -> BARF2D:
    picture = Path(args.peer) / "data" / "cat.jpg"
    overrides = ["backbone=barf2d", f"dataset.image={picture}", "trainer=paper", "ctm=off", f"seed={args.seed}"]
    config = compose(*overrides, f"backbone.encoding={args.encoding}", *args.setting)
    return assemble(config).backbone


class Ours:
    def __init__(self, args: argparse.Namespace):
        keep_memory()
        self.module, self.precision = our_module(args), args.precision
        self.optimizer = self.module.configure_optimizers()

    def step(self, step: int) -> float:
        self.module.progress = step / self.module.total_steps
        with torch.autocast("cpu", torch.bfloat16, enabled=self.precision == "bf16-mixed"):
            loss = self.module.training_step(None, step)["loss"]
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return loss.item()

    def error(self) -> float:
        return self.module.stats()["warp_error"]


class Peer:
    """Its graph, its loss and its optimizer; its own homographies and weights are replaced by ours."""

    def __init__(self, args: argparse.Namespace):
        ours = our_module(args)
        sys.path.insert(0, args.peer)
        for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.functional", "torchvision.utils",
                     "tqdm", "easydict", "visdom", "matplotlib", "matplotlib.pyplot", "mpl_toolkits", "lpips",
                     "mpl_toolkits.mplot3d", "mpl_toolkits.mplot3d.art3d", "termcolor", "IPython", "ipdb",
                     "external", "external.pohsun_ssim", "imageio"):  # fmt: skip
            sys.modules.setdefault(name, MagicMock())
        sys.modules["easydict"].EasyDict = Settings
        import warp
        from model import planar

        scene, encoding = ours.scene, args.encoding
        self.opt = Settings(
            H=scene.height, W=scene.width, H_crop=scene.patch, W_crop=scene.patch, device="cpu", batch_size=5,
            barf_c2f=[0, 0.4] if encoding == "barf" else None,
            arch=Settings(layers=[None, 256, 256, 256, 256, 3], skip=[],
                          posenc=None if encoding == "none" else Settings(L_2D=8)),
            warp=Settings(type="homography", dof=8), loss_weight=Settings(render=0),
        )  # fmt: skip
        self.total, self.true = ours.total_steps, scene.true_warps
        planar.util.get_layer_dims = lambda layers: list(pairwise(layers))
        graph = planar.Graph.__new__(planar.Graph)
        torch.nn.Module.__init__(graph)
        graph.neural_image = planar.NeuralImageFunction(self.opt)
        graph.warp_param = torch.nn.Embedding(5, 8)
        torch.nn.init.zeros_(graph.warp_param.weight)
        self._copy_weights(ours, graph.neural_image.mlp)
        found = warp.warp_grid(self.opt, warp.get_normalized_pixel_grid_crop(self.opt), self.true)
        expected = ours.moved_points(ours.grid).detach()
        assert (found[0] - expected[0]).abs().max() < 1e-6, "the grids differ"
        self.graph, self.patches = graph, scene.patches.permute(0, 3, 1, 2).contiguous()
        self.optimizer = torch.optim.Adam([
            {"params": graph.neural_image.parameters(), "lr": 1e-3},
            {"params": graph.warp_param.parameters(), "lr": 1e-3},
        ])  # fmt: skip

    @staticmethod
    def _copy_weights(ours: BARF2D, layers: torch.nn.ModuleList) -> None:
        """Its embedding takes all sines and all cosines of each coordinate in turn, ours those of each frequency."""
        count = len(ours.image.frequencies)
        columns = [0, 1]
        for coordinate in range(2):
            for wave in range(2):
                columns += [2 + 2 * count * wave + 2 * band + coordinate for band in range(count)]
        with torch.no_grad():
            for layer, source in zip(layers, ours.image.layers, strict=True):
                first = source is ours.image.layers[0] and count
                layer.weight.copy_(source.weight[:, columns] if first else source.weight)
                layer.bias.copy_(source.bias)

    def step(self, step: int) -> float:
        var = SimpleNamespace(image_pert=self.patches)
        var = self.graph.forward(self.opt, var)
        self.optimizer.zero_grad()
        loss = self.graph.compute_loss(self.opt, var).render
        loss.backward()
        self.optimizer.step()
        self.graph.warp_param.weight.data[0] = 0
        self.graph.neural_image.progress.data.fill_((step + 1) / self.total)
        return loss.item()

    def error(self) -> float:
        return (self.graph.warp_param.weight.detach() - self.true).norm(dim=-1).mean().item()


class Settings(dict):
    """A mapping with its keys as attributes, as the peer's code wants."""

    __getattr__ = dict.__getitem__
    __setattr__ = dict.__setitem__


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: str(Path(path).resolve()))
    parser.add_argument("--steps", type=int, default=6)
    parser.add_argument("--every", type=int, default=0, help="print losses and errors every so many steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--encoding", choices=("none", "naive", "barf"), default="barf")
    parser.add_argument("--precision", choices=("32-true", "bf16-mixed"), default="32-true", help="ours")
    parser.add_argument("--setting", action="append", default=[], help="more of our configuration")
    parser.add_argument("--work", choices=("ours", "peer"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.work:
        side = {"ours": Ours, "peer": Peer}[args.work](args)
        return answer(args.work, lambda step: (side.step(step), side.error()), lambda: None)

    turns = Turns()
    found = turns.found
    for step in range(args.steps):
        turns.step(step)
        if args.every and (step + 1) % args.every == 0:
            rows = {name: steps[-1][2] for name, steps in found.items()}
            both = "  ".join(f"{name} loss {loss:.7f} warp error {error:.4f}" for name, (loss, error) in rows.items())
            print(f"{step + 1:5}  {both}", flush=True)
    turns.close()

    print(f"all pixels of 5 patches, {args.encoding}, ours {args.precision}, {torch.get_num_threads()} threads")
    print(f"{'':6}{'s a step':>10}{'peak GiB':>10}{'loss':>12}{'warp error':>12}")
    for name, steps in found.items():
        loss, error = steps[-1][2]
        print(f"{name:6}{turns.seconds(name):10.3f}{turns.memory(name):10.2f}{loss:12.7f}{error:12.4f}")
    losses = [(ours[2][0], peer[2][0]) for ours, peer in zip(found["ours"], found["peer"], strict=True)]
    print(f"losses differ by {max(abs(ours - peer) / peer for ours, peer in losses):.1e} of their size at most")
    print(turns.ratios())


if __name__ == "__main__":
    main()
