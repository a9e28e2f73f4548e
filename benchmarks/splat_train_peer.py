"""Trainings of splats beside OpenSplat's: the same pictures, cameras and first points, each on one core.

``python benchmarks/splat_train_peer.py PEER DATA ["peer -n 500" "ours trainer=quick" ...] [--pictures low]``

PEER is a checkout of https://github.com/WebODM/OpenSplat at bd0400d, built for the CPU in PEER/build; DATA a scene of
LOM, whose test views neither side trains on. Photographs are freed of their lens for both, as the peer does it. Seconds
are the processor's, of a whole process: ours scores and draws in them, and compiles its loops in the first one.
The peer's PLY is rendered here with the principal point in the picture's middle, where the peer takes it to be.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from subprocess import check_output

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from ctm_plugin.backbones.splat import Splat
from ctm_plugin.compose.command_line import compose
from ctm_plugin.export.splats import cameras_in_files, in_files, read_splats, render_splats
from ctm_plugin.metrics.image import psnr
from ctm_plugin.rays.cameras import distort
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.scene.views import composite

TRAININGS = ("ours trainer=quick backbone.steps=400", "ours trainer=quick", "peer -n 2000")
SHARE = 0.992  # sides of a picture without blank corners, of the photograph's
RUN = """import resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL)
print(*resource.getrusage(resource.RUSAGE_CHILDREN)[:3])"""  # a process of its own: a parent's memory would count


def spent(*command: object) -> str:
    """Seconds of the processor and peak memory of a command, which has to succeed."""
    env = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    user, system, memory = map(float, check_output([sys.executable, "-c", RUN, *map(str, command)], env=env).split())
    return f"{user + system:.1f} s, {memory / 2**20:.2f} GiB"


def freed(path: Path, size: Tensor, focal: Tensor, centre: Tensor, distortion: Tensor) -> Image.Image:
    """Free a photograph of its lens; its middle part is left, as large as before."""
    wide, high = (SHARE * size).round().int().tolist()
    places = F.affine_grid(torch.eye(2, 3)[None], [1, 1, high, wide], align_corners=False)[0]  # from -1 to 1
    middle = 2 * centre / size - 1
    lines = torch.stack(distort(*((places - middle) * SHARE * size / 2 / focal).unbind(-1), distortion), -1)
    photograph = torch.from_numpy(np.array(Image.open(path))).permute(2, 0, 1)[None].float()
    pixels = F.grid_sample(photograph, (lines * 2 * focal / size + middle)[None], align_corners=False)[0]
    return Image.fromarray(pixels.permute(1, 2, 0).round().byte().numpy())


def write_scene(data: Path, pictures: str, root: Path) -> None:
    """Write a scene of pinhole ``pictures``: ours reads its pair of files, the peer ``transforms.json``."""
    shutil.copytree(data / "sparse", root / "sparse")
    (root / "images").mkdir()
    for split in ("test", "train"):
        values = json.loads((data / f"transforms_{split}.json").read_text()) | {"k3": 0.0}
        keys = "w h", "fl_x fl_y", "cx cy", "k1 k2 p1 p2 k3"
        lens = [torch.tensor([values[key] for key in each.split()]) for each in keys]
        told = {key: values[key] for key in ("fl_x", "fl_y")} | {key: SHARE * values[key] for key in ("cx", "cy")}
        told |= {key: round(SHARE * values[key]) for key in ("w", "h")} | {"camera_model": "OPENCV", "frames": []}
        for frame in values["frames"]:
            name = Path(frame["file_path"])
            told["frames"].append(frame | {"file_path": f"images/{name.stem}.png"})
            freed(data / pictures / name.name, *lens).save(root / "images" / f"{name.stem}.png")
        (root / f"transforms_{split}.json").write_text(json.dumps(told))
    (root / "transforms.json").write_text(json.dumps(told | {"ply_file_path": "points.ply"}))


@torch.no_grad()
def scored(module: Splat, path: Path) -> str:
    """Number of Gaussians of the peer's PLY, and their PSNR on the test views."""
    views, gaussians, found = module.scene.test, read_splats(path), []
    for camera, image in zip(cameras_in_files(module, views), views.images, strict=True):
        lens = torch.cat([camera.lens[:2], torch.tensor([camera.width / 2, camera.height / 2])])
        picture = render_splats(gaussians, camera._replace(lens=lens), torch.zeros(3)).permute(1, 2, 0)
        found.append(psnr(picture.clamp(0, 1), composite(image, torch.zeros(3))).item())
    return f"{len(gaussians.means)} Gaussians, {np.mean(found):.2f} dB"


def main() -> None:
    """Print a line for each training."""
    parser = argparse.ArgumentParser()
    parser.add_argument("peer", type=lambda path: Path(path).resolve() / "build" / "opensplat")
    parser.add_argument("data", type=lambda path: Path(path).resolve())
    parser.add_argument("trainings", nargs="*", default=TRAININGS, help="a side and its options each")
    parser.add_argument("--pictures", default="high", help="folder of the photographs")
    parser.add_argument("--out", type=lambda path: Path(path).resolve(), default=tempfile.mkdtemp(), help="new folder")
    args = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})  # the peer takes a thread for each core
    write_scene(args.data, args.pictures, args.out)
    ours = ["-m", "ctm_plugin", "dataset=transforms", f"dataset.root={args.out}", "backbone=splat", "logger=none"]
    module = assemble(compose(*ours[2:], "trainer=quick")).backbone
    table = np.concatenate([in_files(module.gaussians, module.scene).means, (255 * module.first_colors).round()], 1)
    parts = ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
    head = "\n".join([f"ply\nformat ascii 1.0\nelement vertex {len(table)}", *(f"property {part}" for part in parts)])
    np.savetxt(args.out / "points.ply", table, "%.9g", header=f"{head}\nend_header", comments="")
    for turn, training in enumerate(args.trainings):
        (side, *options), made = training.split(), args.out / str(turn)
        if side == "peer":
            cost = spent(args.peer, args.out, *options, "-o", f"{made}.ply")
            found = scored(module, Path(f"{made}.ply"))
        else:
            cost = spent(sys.executable, *ours, *options, f"hydra.run.dir={made}")
            means = torch.load(made / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]["tables.means"]
            found = f"{len(means)} Gaussians, {json.loads((made / 'metrics.json').read_text())['psnr']:.2f} dB"
        print(f"{training}: {cost}, {found}", flush=True)


if __name__ == "__main__":
    main()
