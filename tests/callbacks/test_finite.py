"""What is no number stops the run, in the step and by the name of the term."""

import math

import lightning as L
import pytest
import torch
from lightning.pytorch.plugins import MixedPrecision
from toy import Toy, copied, same, small_ctm, trainer

from ctm_plugin.callbacks.checkpoint import LastCheckpoint
from ctm_plugin.callbacks.dashboard import Dashboard
from ctm_plugin.callbacks.finite import FiniteLoss
from ctm_plugin.errors import DivergedError
from ctm_plugin.loggers.services import TensorBoard

STEPS = 6


class Spoiled(Toy):
    """Has a regulariser that is ``value`` in one batch, as has its gradient."""

    def __init__(self, batch: int, value: float):
        super().__init__(STEPS)
        self.batch, self.value = batch, value

    def regularisers(self, batch, rendering, target):
        number = self.batches_seen - 1
        return {"smooth": 0 * rendering.latent.sum() + (self.value if number == self.batch else 0.0)}


def fit(toy: Toy, tmp_path, *callbacks: L.Callback, every: int = 2, **settings) -> L.Trainer:
    path = tmp_path / "last.ckpt"
    keep = [FiniteLoss(path), *callbacks, LastCheckpoint(tmp_path, path, tmp_path / "previous.ckpt", every)]
    fitter = trainer(STEPS, *keep, **settings)
    fitter.fit(toy)
    return fitter


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("batch", "accumulate", "step", "kept"), [(0, 1, 0, 0), (3, 1, 3, 2), (5, 2, 2, 2), (9, 2, 4, 4)]
)
def test_a_term_that_is_no_number(tmp_path, value, batch, accumulate, step, kept):
    toy = Spoiled(batch, value)
    message = rf"step {step}: loss term 'smooth' is {value}; training stopped, last good checkpoint kept: "
    with pytest.raises(DivergedError, match=message + (str(tmp_path / "last.ckpt") if kept else "none yet")):
        fit(toy, tmp_path, accumulate_grad_batches=accumulate)
    assert all(bool(value.isfinite().all()) for value in toy.state_dict().values())
    if kept:
        saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
        assert saved["global_step"] == kept
        assert all(bool(value.isfinite().all()) for value in saved["state_dict"].values())
    else:
        assert not list(tmp_path.glob("*"))


def test_the_first_term_is_named(tmp_path):
    toy = Toy(1)
    toy.terms = {"enc": torch.tensor(1.0), "img": torch.tensor(math.nan), "rand": torch.tensor(math.inf)}
    watch = FiniteLoss(tmp_path)
    with pytest.raises(DivergedError, match="'img' is nan"):
        watch.on_before_backward(trainer(1), toy, torch.tensor(0.0))


class Poison(L.Callback):
    """Gradients that are no number, though the loss is one."""

    def on_after_backward(self, trainer, pl_module):
        if trainer.global_step == 3:
            pl_module.layer.weight.grad[0, 0] = math.nan


def test_parameters_that_are_no_numbers_are_not_saved(tmp_path):
    with pytest.raises(DivergedError, match=r"step 4: parameter 'layer\.weight' is nan; training stopped"):
        fit(Toy(STEPS, small_ctm()), tmp_path, Poison())
    saved = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert saved["global_step"] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]


def test_they_stop_the_next_step_where_none_is_saved(tmp_path):
    with pytest.raises(DivergedError, match="step 4: loss term 'enc' is nan"):
        fit(Toy(STEPS, small_ctm()), tmp_path, Poison(), every=100)


class PoisonAll(L.Callback):
    def on_after_backward(self, trainer, pl_module):
        if trainer.global_step == 3:
            for parameter in pl_module.parameters():
                parameter.grad.fill_(math.nan)


@pytest.mark.parametrize("k", [3, 5])
def test_pictures_of_no_numbers_do_not_come_before_it(tmp_path, k):
    watch = [PoisonAll(), FiniteLoss(tmp_path / "last.ckpt"), Dashboard()]
    logger = TensorBoard(TensorBoard.Config(), tmp_path, 0)
    fitter = trainer(STEPS, *watch, logger=logger, log_every_n_steps=1, limit_val_batches=1, val_check_interval=1)
    with pytest.raises(DivergedError, match="step 4: loss term 'enc' is nan"):
        fitter.fit(Toy(STEPS, small_ctm(k=k)))


def test_an_overflow_of_scaled_gradients_is_not_mistaken_for_it(tmp_path):
    seen = []

    class Look(L.Callback):
        def on_train_batch_end(self, trainer, pl_module, *args):
            seen.append((copied(pl_module), scaler.get_scale()))

    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**120)
    fit(Toy(STEPS, small_ctm()), tmp_path, Look(), plugins=[MixedPrecision("16-mixed", "cpu", scaler)])
    assert [scale for _, scale in seen] == [2.0 ** (119 - step) for step in range(STEPS)]
    assert all(same(weights, seen[0][0]) for weights, _ in seen)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == STEPS
