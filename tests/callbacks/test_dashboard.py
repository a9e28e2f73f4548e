"""What loggers get: curves by name, pictures, histograms; and what it has after an interruption."""

import io
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import lightning as L
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy import LR, Clock, Toy, small_ctm, trainer

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks import dashboard
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.color.settings import TransformTraining
from ctm_plugin.metrics.image import psnr
from ctm_plugin.runs.train import resume, train
from ctm_plugin.show.pictures import error_picture


class Watched(Toy):
    def stats(self):
        return {"answer": 42.0}


def curves(tmp_path, monkeypatch, *callbacks: L.Callback, log_every: int = 2, **settings) -> dict[int, dict[str, Any]]:
    """What is logged, by step."""
    logged = {}
    monkeypatch.setattr(dashboard, "time", Clock(0.5))
    monkeypatch.setattr(
        TensorBoardLogger, "log_metrics", lambda self, metrics, step=None: logged.update({step: metrics})
    )
    ctm = small_ctm(learning=TransformTraining(lr=0.02, lr_decay=0.1))
    logger = TensorBoardLogger(tmp_path)
    settings |= {"logger": logger, "log_every_n_steps": log_every}
    trainer(6, Dashboard(), *callbacks, **settings).fit(Watched(6, ctm))
    return logged


class Look(L.Callback):
    def __init__(self):
        self.outputs, self.terms = {}, {}

    def on_train_batch_end(self, trainer, pl_module, outputs, *args):
        self.outputs.setdefault(trainer.global_step, outputs)
        self.terms.setdefault(trainer.global_step, pl_module.terms)
        self.transform = pl_module.transform


@pytest.mark.parametrize("accumulate", [1, 2])
def test_curves(tmp_path, monkeypatch, accumulate):
    look = Look()
    logged = curves(tmp_path, monkeypatch, look, accumulate_grad_batches=accumulate)
    assert list(logged) == [2, 4, 6]
    terms = {"enc", "dec", "img", "rand", "latent"}
    tags = {f"loss/{name}" for name in terms | {"total"}} | {"psnr/rgb", "psnr/latent", "lr/field", "lr/ctm"}
    for step, values in logged.items():
        assert values.keys() == tags | {"speed/rays_per_second", "speed/ms_per_step", "field/answer"}
        assert values["field/answer"] == 42.0
        assert values["lr/field"] == pytest.approx(LR * 0.9 ** (step - 1))
        assert values["lr/ctm"] == pytest.approx(0.02 * 0.1 ** ((step - 1) / 6))
        assert values["speed/rays_per_second"] == 2 * accumulate * Toy.batch_rays / 0.5
        assert values["speed/ms_per_step"] == 250  # half a second for two steps
        outputs = look.outputs[step]
        assert {name: values[f"loss/{name}"] for name in terms} == {k: float(v) for k, v in look.terms[step].items()}
        assert values["psnr/latent"] == pytest.approx(float(psnr(outputs["latent"][None], outputs["target"][None])))
    with torch.no_grad():
        rgb = look.transform.decode(outputs["latent"]).clamp(0, 1)
    assert values["psnr/rgb"] == pytest.approx(float(psnr(rgb[None], outputs["rgb"][None])))
    assert values["loss/total"] == pytest.approx(sum(values[f"loss/{name}"] for name in terms))


SIZES = ("backbone.coarse=false", "backbone.steps_alone=6", "backbone.grow=[]", "dataset.exposure=0.1")
EVERY = ("trainer.log_every=2", "trainer.image_every=4")
STEPS = [0, 4, 6]
"""Of pictures: the first is made before the first step, the last after the last one."""
LATENTS = {"scene": 1024, "render": 144}


@pytest.fixture(scope="module")
def events(compose, tmp_path_factory) -> EventAccumulator:
    """Of a short run of DVGO."""
    run = tmp_path_factory.mktemp("run")
    train(compose(*SIZES, *EVERY), run)
    return read(run)


def read(run: Path) -> EventAccumulator:
    everything = {"images": 0, "scalars": 0, "histograms": 0, "tensors": 0}
    return EventAccumulator(str(run / "tensorboard"), everything).Reload()


def test_tags_of_a_run(events):
    terms = ("enc", "dec", "img", "rand", "latent", "entropy", "point", "total")
    rates = ("lr/grids/density", "lr/grids/features", "lr/mlp", "lr/ctm")
    scores = ("psnr/rgb", "psnr/latent", "psnr/test_view", "psnr/test_view_brightened", "field/occupied_fraction")
    speed = ("speed/rays_per_second", "speed/ms_per_step")
    curves = {tag for tag in events.Tags()["scalars"] if not tag.startswith("final/")}
    assert curves == {*(f"loss/{term}" for term in terms), *rates, *scores, *speed}
    assert [event.step for event in events.Scalars("loss/total")] == [2, 4, 6]
    assert [event.step for event in events.Scalars("psnr/test_view")] == STEPS
    names = ("render", "target", "latent", "depth", "error", "lit")
    assert set(events.Tags()["images"]) == {"colors/cube", *(f"test/{name}" for name in names)}
    tags = {f"latent/{name}_{channel}": count for name, count in LATENTS.items() for channel in "012"}
    assert set(events.Tags()["histograms"]) == tags.keys()
    for tag, count in tags.items():
        found = events.Histograms(tag)
        assert [event.step for event in found] == STEPS
        assert {sum(event.histogram_value.bucket) for event in found} == {count}


def decoded(event: Any) -> torch.Tensor:
    return torch.from_numpy(iio.imread(io.BytesIO(event.encoded_image_string))).double() / 255


def test_pictures_are_of_one_test_view(events):
    pictures = {}
    for tag in events.Tags()["images"]:
        assert [event.step for event in events.Images(tag)] == STEPS
        pictures[tag] = decoded(events.Images(tag)[-1])
        assert pictures[tag].shape == {"test/lit": (12, 26, 3), "colors/cube": (258, 258, 3)}.get(tag, (12, 12, 3))
    render, target = pictures["test/render"], pictures["test/target"]
    score = events.Scalars("psnr/test_view")[-1]
    assert float(psnr(render[None], target[None])) == pytest.approx(score.value, abs=0.1)  # rounded to 8 bits
    assert float(pictures["test/lit"][:, -12:].mean()) > float(target.mean())
    expected = error_picture((render - target).abs().mean(-1), float(target.max()) / 4).double()
    torch.testing.assert_close(pictures["test/error"], expected, atol=0.06, rtol=0)  # rounded too


def everything(run: Path) -> dict[str, list[Any]]:
    """Steps and values by tag, but for the time that things took."""
    events, found = read(run), {}
    for tag in events.Tags()["scalars"]:
        timed = tag.startswith(("speed/", "final/train_seconds", "final/rays_per_second", "final/peak_memory_mb"))
        found[tag] = [(event.step, None if timed else event.value) for event in events.Scalars(tag)]
    for tag in events.Tags()["images"]:
        found[tag] = [(event.step, event.encoded_image_string) for event in events.Images(tag)]
    for tag in events.Tags()["histograms"]:
        found[tag] = [(event.step, event.histogram_value.bucket) for event in events.Histograms(tag)]
    found["tensors"] = sorted(events.Tags()["tensors"])
    return found


@pytest.fixture(scope="module")
def whole(compose, tmp_path_factory) -> tuple[dict[str, Any], Path]:
    """A configuration with a checkpoint in step 3, and its run that nothing interrupted."""
    config = compose(*SIZES, "trainer.log_every=1", "trainer.image_every=2", "trainer.checkpoint_every=3", "ctm=off")
    run = tmp_path_factory.mktemp("whole") / "run"
    train(config, run)
    return config, run


def test_a_resumed_run_has_every_point_once(whole, tmp_path, monkeypatch):
    """Killed in a step, with points on disk that came after its last checkpoint, in step 3."""
    config, uninterrupted = whole
    step = Backbone.training_step

    def die(self, *args):
        if self.batches_seen == 4:
            self.trainer.logger.experiment.flush()
            raise RuntimeError("killed")
        return step(self, *args)

    with monkeypatch.context() as patch:
        patch.setattr(Backbone, "training_step", die)
        with pytest.raises(RuntimeError, match="killed"):
            train(config, tmp_path / "run")
    before = read(tmp_path / "run").Scalars("loss/total")
    assert [event.step for event in before] == [1, 2, 3, 4]
    resume(tmp_path / "run")
    assert everything(tmp_path / "run") == everything(uninterrupted)
    assert [step for step, _ in everything(tmp_path / "run")["loss/total"]] == [1, 2, 3, 4, 5, 6]


def test_a_checkpoint_is_not_written_before_the_points_up_to_it(compose, tmp_path, monkeypatch):
    """A process that is killed after its checkpoint has no time to write what it still holds."""
    config = compose(*SIZES, "trainer.log_every=1", "trainer.image_every=null", "trainer.checkpoint_every=3")
    seen = {}
    save = L.Trainer.save_checkpoint

    def save_checkpoint(self, path, *args, **kwargs):
        save(self, path, *args, **kwargs)
        seen[self.global_step] = [event.step for event in read(tmp_path / "run").Scalars("loss/total")]

    monkeypatch.setattr(L.Trainer, "save_checkpoint", save_checkpoint)
    train(config, tmp_path / "run")
    assert seen == {3: [1, 2, 3], 6: [1, 2, 3, 4, 5, 6]}
