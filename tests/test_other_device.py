"""What a GPU runs, on a device that computes on the CPU and takes no tensors of the CPU's: see ``other_device.py``.

On a GPU itself: ``test_gpu.py``.
"""

import functools
import json
from pathlib import Path

import lightning as L
import pytest
import torch
from faults import differences
from other_device import BRIEF, DEVICE, SETTINGS, STEP_WAITS, Elsewhere, strategy, switched_on, waits
from pages import load

from ctm_plugin.errors import Interrupted
from ctm_plugin.runs import evaluate
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.rundir import METRICS
from ctm_plugin.runs.settings import TrainerConfig
from ctm_plugin.runs.train import resume, train

subject = load("benchmarks/step.py")


@pytest.fixture(scope="module")
def configuration(compose, hall):
    return lambda name, *more: compose(*more, *(each.replace("HALL", str(hall)) for each in SETTINGS[name]))


@pytest.fixture
def there():
    with switched_on():
        yield


def train_there(monkeypatch) -> None:
    monkeypatch.setattr(TrainerConfig, "strategy", property(strategy))
    monkeypatch.setattr(TrainerConfig, "backend", "auto")  # the strategy's


def test_the_device_itself(there):
    numbers, weight = torch.ones(3, device=DEVICE), torch.nn.Linear(3, 2).to(DEVICE).weight
    assert isinstance(weight, Elsewhere)
    (weight @ numbers).sum().backward()
    assert weight.grad.tolist() == [[1.0] * 3] * 2
    with pytest.raises(RuntimeError, match="both devices"):
        numbers + torch.ones(3)
    waits.clear()
    assert (numbers + 1).sum().item() == 6
    assert numbers[numbers > 0].shape == (3,)
    assert numbers.to("cpu").device.type == "cpu"
    assert [each.split(" in ")[0] for each in waits] == ["_local_scalar_dense", "index", "_to_copy"]


@pytest.fixture(scope="module")
def whole(configuration, tmp_path_factory):
    """A configuration by its name, and its run there: training, dashboard, film, checkpoint and scores."""

    @functools.cache
    def made(name: str) -> tuple[dict, Path]:
        config = configuration(name, *BRIEF)
        run = tmp_path_factory.mktemp("whole") / "run"
        scored_on, score = [], evaluate.score
        with pytest.MonkeyPatch.context() as patch, switched_on():
            train_there(patch)
            patch.setattr(
                "ctm_plugin.runs.train.score",
                lambda module, *args: scored_on.append(module.device) or score(module, *args),
            )
            train(config, run)
        assert scored_on == [DEVICE]
        return config, run

    return made


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.slow
def test_a_whole_run(name, whole, tmp_path):
    """What a CPU makes of it but for rounding."""
    config, run = whole(name)
    found = json.loads((run / METRICS).read_text())
    assert found["psnr"] == pytest.approx(train(config, tmp_path)["psnr"], abs=0.05)


@pytest.mark.parametrize(
    ("name", "steps"), [("dvgo", (3, 15)), ("nerf", (3,)), ("ngp", (3, 12)), ("splat", (3, 12)), ("barf2d", (3,))]
)
@pytest.mark.slow
def test_an_interrupted_run_goes_on(name, steps, whole, tmp_path, monkeypatch, ctrl_c):
    config, expected = whole(name)
    train_there(monkeypatch)
    ctrl_c(lambda seen: seen in steps)
    with switched_on():
        with pytest.raises(Interrupted):
            train(config, tmp_path / "run")
        for _ in steps[1:]:
            with pytest.raises(Interrupted):
                resume(tmp_path / "run")
        resume(tmp_path / "run")
    assert differences(tmp_path / "run", expected) == []


@pytest.mark.parametrize(("name", "expected"), STEP_WAITS.items())
def test_what_a_step_waits_for(name, expected, configuration, there):
    parts = assemble(configuration(name, "ctm=on"))
    side = subject.Side(parts.backbone.to(DEVICE), False)
    waits.clear()
    side.step()
    assert waits == expected


def test_the_benchmark_is_of_the_device(configuration, monkeypatch, there):
    trainer = L.Trainer
    monkeypatch.setattr(
        subject.L, "Trainer", lambda accelerator, devices, **options: trainer(strategy=strategy(), **options)
    )
    parts = assemble(configuration("nerf", "ctm=off"))
    assert subject.warm(parts, 1) == DEVICE
    assert {tensor.device for tensor in (*parts.backbone.parameters(), *parts.backbone.buffers())} == {DEVICE}
