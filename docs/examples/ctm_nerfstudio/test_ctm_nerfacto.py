"""Nerfstudio itself trains a small nerfacto on a dark scene through the plug-in: ``make test-nerfstudio``."""

import json
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import torchvision
from ctm_nerfstudio import model
from nerfstudio.model_components import renderers
from nerfstudio.scripts import eval as ns_eval
from nerfstudio.scripts import train as ns_train
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from ctm_plugin.color.auto import Auto
from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.settings import CTMConfig
from ctm_plugin.color.spaces.rgb import Space as RGB
from ctm_plugin.compose.command_line import compose
from ctm_plugin.errors import ConfigError
from ctm_plugin.runs.assemble import load_scene

STEPS = 40
SMALL = shlex.split("""
    --machine.device-type cpu --machine.num-devices 1 --vis tensorboard --timestamp run --logging.steps-per-log 1
    --pipeline.datamanager.train-num-rays-per-batch 128 --pipeline.model.implementation torch
    --pipeline.model.max-res 64 --pipeline.model.num-levels 4 --pipeline.model.log2-hashmap-size 10
    --pipeline.model.num-nerf-samples-per-ray 12 --pipeline.model.num-proposal-samples-per-ray 24 16
    --steps-per-eval-batch 20 --steps-per-eval-image 1000 --steps-per-eval-all-images 1000
""")


@pytest.fixture(scope="session")
def scene(tmp_path_factory) -> Path:
    """A transforms.json of fourteen of the dark room's pictures, small."""
    folder = tmp_path_factory.mktemp("scene")
    views = load_scene(compose("dataset=white_room", "dataset.downscale=3")).train
    frames = []
    for index in range(0, len(views), 3):
        Image.fromarray(views.images[index].numpy()).save(folder / f"{index:02d}.png")
        pose = [*views.c2w[index, :3].tolist(), [0, 0, 0, 1]]
        frames.append({"file_path": f"{index:02d}.png", "transform_matrix": pose})
    camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), views.intrinsics[0].tolist(), strict=True))
    camera |= {"w": views.width, "h": views.height, "camera_model": "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames}))
    return folder


@pytest.fixture(scope="session", autouse=True)
def no_download(tmp_path_factory) -> None:
    """Nerfacto asks for AlexNet's weights before it trains; here LPIPS has random ones, and is not looked at."""
    folder = tmp_path_factory.mktemp("hub")
    (folder / "checkpoints").mkdir()
    torch.hub.set_dir(folder)
    torch.save(torchvision.models.alexnet().state_dict(), folder / "checkpoints" / "alexnet-owt-7be5be79.pth")


def train(scene: Path, folder: Path, *arguments: str, steps: int = STEPS) -> Path:
    """What ``ns-train ctm-nerfacto`` does, here; the run's folder."""
    command = ["ns-train", "ctm-nerfacto", *SMALL, "--output-dir", str(folder), "--experiment-name", "small"]
    data = ["nerfstudio-data", "--data", str(scene)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [*command, "--max-num-iterations", str(steps), *arguments, *data])
        ns_train.entrypoint()
    return folder / "small" / "ctm-nerfacto" / "run"


@pytest.fixture(scope="session")
def auto(scene, tmp_path_factory) -> Path:
    return train(scene, tmp_path_factory.mktemp("auto"))


@pytest.fixture(scope="session")
def quick(scene, tmp_path_factory) -> Path:
    return train(scene, tmp_path_factory.mktemp("quick"), "--pipeline.model.colors", "quick", "ctm.k=4")


def checkpoint(run: Path, steps: int = STEPS) -> dict:
    return torch.load(run / "nerfstudio_models" / f"step-{steps - 1:09d}.ckpt", weights_only=True)


def curve(run: Path, name: str) -> list[float]:
    events = EventAccumulator(str(run)).Reload()
    return [event.value for event in events.Scalars(name)]


def photographs(scene: Path) -> torch.Tensor:
    """Their colours, ``[N, 3]``."""
    pictures = [np.asarray(Image.open(path), np.float32) / 255 for path in sorted(scene.glob("*.png"))]
    return torch.from_numpy(np.stack(pictures)).flatten(0, -2)


def test_a_dark_scene_s_loss_falls(auto):
    """Step by step, by name, in training and evaluation."""
    loss = curve(auto, "Train Loss Dict/color_loss")
    assert len(loss) == STEPS
    assert np.mean(loss[-5:]) < 0.5 * np.mean(loss[:5])
    assert "Train Loss Dict/rgb_loss" not in EventAccumulator(str(auto)).Reload().Tags()["scalars"]
    assert len(curve(auto, "Eval Loss Dict/color_loss")) > 0


def test_the_fit_is_in_the_checkpoint(auto, scene):
    """Of pixels drawn, close to that of all; a fixed transform has no optimizer."""
    expected, state = Auto(), checkpoint(auto)
    expected.begin(photographs(scene))
    torch.testing.assert_close(state["pipeline"]["_model.transform.level"], expected.level, rtol=0.2, atol=0)
    assert set(state["optimizers"]) == {"proposal_networks", "fields", "camera_opt"}


def test_a_learned_transform_of_four_channels_has_its_own_adam(quick):
    state = checkpoint(quick)
    held = state["pipeline"]
    assert held["_model.field.mlp_head.layers.2.weight"].shape[0] == 4
    own = {name.removeprefix("_model.transform."): value for name, value in held.items() if "transform." in name}
    CTM(CTMConfig(k=4)).load_state_dict(own)
    adam = state["optimizers"]["ctm"]
    assert len(adam["state"]) == len(own)
    assert {float(each["step"]) for each in adam["state"].values()} == {1500 + STEPS}  # it was pre-trained, too
    assert adam["param_groups"][0]["lr"] == 5e-4
    loss = curve(quick, "Train Loss Dict/enc_loss")
    assert np.mean(loss[-5:]) < np.mean(loss[:5])


@pytest.mark.parametrize("run", ["auto", "quick"])
def test_metrics_and_pictures_are_of_decoded_colours(run, request, scene, tmp_path, monkeypatch):
    """Ns-eval's PSNR is that of the pictures it writes: the dark photograph beside what was rendered."""
    config = request.getfixturevalue(run) / "config.yml"
    command = ["--load-config", config, "--output-path", tmp_path / "found.json", "--render-output-path", tmp_path]
    monkeypatch.setattr(sys, "argv", ["ns-eval", *map(str, command)])
    ns_eval.entrypoint()
    found = json.loads((tmp_path / "found.json").read_text())["results"]["psnr"]
    each = []
    for path in sorted(tmp_path.glob("eval_img_*.png")):
        photograph, rendered = np.split(np.asarray(Image.open(path), np.float64) / 255, 2, axis=1)
        assert photograph.mean() < 0.1
        each.append(-10 * np.log10(np.mean((photograph - rendered) ** 2)))
    assert np.mean(each) == pytest.approx(found, abs=0.3)  # pictures have 8 bits
    colors = photographs(scene)
    assert found > -10 * (colors - colors.mean(0)).square().mean().log10() + 2  # more than one colour for all


def test_going_on_fits_nothing_anew(quick, scene, tmp_path, monkeypatch):
    monkeypatch.setattr(model.ctm, "fit", lambda *given, **more: pytest.fail("fitted anew"))
    more = ("--pipeline.model.colors", "quick", "ctm.k=4", "--load-dir", str(quick / "nerfstudio_models"))
    adam = checkpoint(train(scene, tmp_path, *more, steps=2), STEPS + 2)["optimizers"]["ctm"]
    assert {float(each["step"]) for each in adam["state"].values()} == {1500 + STEPS + 2}


def test_a_random_background_is_under_both():
    """Under transparent photographs, and under renderings as its latent; no brighter than the scene."""
    auto = Auto()
    auto.begin(0.02 * torch.rand(1000, 3))
    renderer = model.LatentRenderer("random", auto)
    clear = torch.zeros(500, 4)
    latent, color = renderer.blend_background_for_loss_computation(torch.zeros(500, 3), torch.zeros(500, 1), clear)
    torch.testing.assert_close(latent, auto.encode(color))
    assert 0 <= color.min() < 0.002
    assert 0.018 < color.max() < 0.021


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("background", ["last_sample", "random", "white", "black"])
def test_the_renderer_is_nerfstudio_s_where_latents_are_colours(background, training):
    samples, weights = torch.rand(5, 7, 3), torch.rand(5, 7, 1) / 7
    ours, theirs = model.LatentRenderer(background, RGB()), renderers.RGBRenderer(background)
    expected = theirs.train(training)(rgb=samples, weights=weights)
    torch.testing.assert_close(ours.train(training)(rgb=samples, weights=weights), expected)


@pytest.mark.parametrize(
    ("colors", "message"),
    [
        (["auto", "backbone=nerf"], "transform: found 'backbone=nerf', expected settings of the transform"),
        (["qick"], "transform: found 'qick', expected one of auto"),
        (["quick", "ctm.lr_decay=0.1"], "ctm.lr_decay: found 0.1, expected 1: your training schedules the optimizer"),
    ],
)
def test_mistakes_are_told_before_training(scene, tmp_path, colors, message):
    with pytest.raises(ConfigError, match=message):
        train(scene, tmp_path, "--pipeline.model.colors", *colors)
