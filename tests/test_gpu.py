"""What a GPU makes of every backbone, beside what the CPU makes of it: ``make test-gpu``.

What any machine can see of it: ``test_other_device.py``.
"""

import warnings

import pytest
import torch
from other_device import BRIEF, SETTINGS, STEP_WAITS
from pages import load

from ctm_plugin import door
from ctm_plugin.draws import Draws
from ctm_plugin.errors import Interrupted
from ctm_plugin.gpu import trial
from ctm_plugin.optim import grid_adam
from ctm_plugin.rays import hash_density, occupancy
from ctm_plugin.runs.assemble import assemble
from ctm_plugin.runs.evaluate import evaluate
from ctm_plugin.runs.train import resume, train
from ctm_plugin.splats import render

WITH_KERNELS = grid_adam, hash_density, occupancy, render
Side = load("benchmarks/step.py").Side
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="make test-gpu runs them, where there is a GPU")


@pytest.fixture(scope="module")
def configuration(compose, hall):
    return lambda name, *more: compose(*more, *(each.replace("HALL", str(hall)) for each in SETTINGS[name]))


@pytest.fixture(autouse=True)
def the_cpus_numbers(monkeypatch):
    """Both devices draw the same random numbers: the CPU's."""
    start = Draws.__init__

    def init(self, seed, step, device="cpu", rank=0, world=1, stream=""):
        start(self, seed, step, "cpu", rank, world, stream)
        self.wanted = device

    monkeypatch.setattr(Draws, "__init__", init)
    for name in ("uniform", "normal", "integers"):
        drawn = getattr(Draws, name)
        monkeypatch.setattr(Draws, name, lambda self, *args, drawn=drawn: drawn(self, *args).to(self.wanted))


@pytest.mark.parametrize("name", trial.TRIALS)
def test_the_kernels(name):
    """Each is as good as plain torch, and is used."""
    assert all(WITH_KERNELS)  # what is imported is registered
    (reference,) = (call.reference for call in door.registered.values() if call.kernel == name)
    kernel = door.named("gpu", name)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        assert trial.tried(name, lambda: kernel, reference, torch.device("cuda")) is kernel


@pytest.mark.parametrize("precision", ["32-true", "auto"])
@pytest.mark.parametrize("name", SETTINGS)
def test_a_whole_run(name, precision, configuration, tmp_path):
    """What the CPU makes of it but for rounding, and the CPU reads what was trained there."""
    config = configuration(name, *BRIEF, f"trainer.precision={precision}", "trainer.accelerator=auto")
    found = train(config, tmp_path / "gpu")
    assert found["precision"] == {"auto": "bf16-mixed"}.get(precision, precision)
    assert 0 < found["peak_memory_mb"] <= torch.cuda.max_memory_reserved() / 2**20
    assert evaluate(tmp_path / "gpu")["psnr"] == pytest.approx(found["psnr"], abs=0.01)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.cuda, "is_available", lambda: False)
        assert evaluate(tmp_path / "gpu")["psnr"] == pytest.approx(found["psnr"], abs=0.05)
        there = train(configuration(name, *BRIEF, "trainer.precision=32-true"), tmp_path / "cpu")
    assert found["psnr"] == pytest.approx(there["psnr"], abs=0.1 if precision == "32-true" else 0.5)


@pytest.mark.parametrize("name", SETTINGS)
def test_the_gradients_of_a_step(name, configuration):
    found = []
    for device in ("cpu", "cuda"):
        parts = assemble(configuration(name, "ctm=on"))
        module = Side(parts.backbone.to(device), False).module
        module.training_step(None, 0)["loss"].backward()
        found.append({name: each.grad for name, each in module.named_parameters() if each.grad is not None})
    ours, theirs = found
    assert ours.keys() == theirs.keys() != set()
    for key, grad in ours.items():
        grad = grad.to_dense() if grad.is_sparse else grad
        apart = (theirs[key].cpu() - grad).norm() / grad.norm()
        # NeRF's fine samples lie where the coarse ones' weights, which are rounded, say.
        assert apart < (0.1 if key.startswith("fine.") else 1e-3), f"{key}: {apart}"


# torch.matrix_exp looks at the matrices' norms.
PLANAR_WAITS = 6


@pytest.mark.parametrize("name", SETTINGS)
def test_what_a_step_waits_for(name, configuration, monkeypatch):
    monkeypatch.undo()  # the GPU draws its own numbers
    parts = assemble(configuration(name, "ctm=on"))
    side = Side(parts.backbone.to("cuda"), False)
    side.step()
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as seen:
            warnings.simplefilter("always")
            side.step()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    found = [f"{each.filename}:{each.lineno}" for each in seen if "synchroniz" in str(each.message)]
    assert len(found) <= len(STEP_WAITS[name]) + PLANAR_WAITS * name.startswith("barf2d"), found


@pytest.mark.parametrize("name", ["dvgo", "nerf", "ngp", "splat", "barf2d"])
def test_an_interrupted_run_goes_on(name, configuration, tmp_path, ctrl_c):
    """To what an uninterrupted one comes to, but for the order in which a GPU adds up."""
    config = configuration(name, *BRIEF, "trainer.accelerator=auto")
    expected = train(config, tmp_path / "whole")
    ctrl_c(lambda seen: seen == 3)
    with pytest.raises(Interrupted):
        train(config, tmp_path / "run")
    assert resume(tmp_path / "run")["psnr"] == pytest.approx(expected["psnr"], abs=0.1)
