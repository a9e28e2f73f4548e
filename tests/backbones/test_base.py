"""The transform's own optimizer, against two Adams stepped by hand."""

from contextlib import nullcontext

import lightning as L
import pytest
import torch
from callbacks.toy import LR, Toy, copied, same, small_ctm, trainer
from lightning.pytorch.plugins import MixedPrecision
from torch.optim import Adam

from ctm_plugin.color.ctm import CTM
from ctm_plugin.color.prepare import PRETRAIN_COLORS
from ctm_plugin.color.settings import CTMConfig, LossWeights, TransformTraining
from ctm_plugin.color.spaces.hsv import Space as HSV
from ctm_plugin.color.transform import ColorTransform
from ctm_plugin.draws import Draws
from ctm_plugin.errors import ConfigError

STEPS = 6
TRAINING = TransformTraining(lr=0.02, betas=(0.8, 0.95), lr_decay=0.1)


def fit(training: TransformTraining = TRAINING, *callbacks: L.Callback, steps: int = STEPS, **settings) -> Toy:
    toy = Toy(steps, small_ctm(learning=training))
    trainer(steps, *callbacks, **settings).fit(toy)
    return toy


class ByHand:
    """The same training without Lightning and without this package's optimizers."""

    def __init__(self, training: TransformTraining = TRAINING):
        self.toy, self.ctm, self.training = Toy(STEPS), small_ctm(), training
        self.adams = {
            "field": Adam(self.toy.layer.parameters(), LR),
            "ctm": Adam(self.ctm.parameters(), training.lr, training.betas, fused=True),
        }

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        return [*self.toy.layer.parameters(), *self.ctm.parameters()]

    def loss(self, number: int, dtype: torch.dtype | None = None) -> torch.Tensor:
        """Of one batch."""
        draws = Draws(0, number)
        with torch.autocast("cpu", dtype, cache_enabled=False) if dtype else nullcontext():
            batch = self.toy.draw(draws)
            latents = self.toy.predict(batch, draws).latents
            terms, _ = self.ctm.losses(latents, batch.rgb, self.toy.photometric, draws.uniform)
            return sum(terms.values())

    def set_rates(self, step: int) -> None:
        self.adams["field"].param_groups[0]["lr"] = LR * 0.9**step
        self.adams["ctm"].param_groups[0]["lr"] = self.training.lr * self.training.lr_decay ** (step / STEPS)

    def run(self, accumulate: int = 1, clip: float | None = None, dtype: torch.dtype | None = None) -> "ByHand":
        for step in range(STEPS):
            self.set_rates(step)
            for adam in self.adams.values():
                adam.zero_grad()
            for part in range(accumulate):
                (self.loss(step * accumulate + part, dtype) / accumulate).backward()
            if clip is not None:
                torch.nn.utils.clip_grad_norm_(self.parameters, clip)
            for adam in self.adams.values():
                adam.step()
        return self


def moments(adam: Adam) -> list[torch.Tensor]:
    return [value for state in adam.state.values() for value in state.values()]


def equal(toy: Toy, hand: ByHand) -> bool:
    """Weights and both Adams' moments and step counts, bit for bit."""
    members = toy.named_optimizers.members
    left = [*moments(members["field"]), *moments(members["ctm"])]
    right = [*moments(hand.adams["field"]), *moments(hand.adams["ctm"])]
    return (
        same(toy.layer.state_dict(), hand.toy.layer.state_dict())
        and same(toy.transform.state_dict(), hand.ctm.state_dict())
        and len(left) == len(right) > 0
        and all(torch.equal(a, b) for a, b in zip(left, right, strict=True))
    )


@pytest.mark.parametrize("accumulate", [1, 3])
@pytest.mark.parametrize("clip", [None, 0.5])
@pytest.mark.parametrize(("precision", "dtype"), [("32-true", None), ("bf16-mixed", torch.bfloat16)])
def test_equals_two_adams_by_hand(accumulate, clip, precision, dtype):
    toy = fit(accumulate_grad_batches=accumulate, gradient_clip_val=clip, precision=precision)
    assert equal(toy, ByHand().run(accumulate, clip, dtype))
    assert toy.trainer.global_step == STEPS
    assert toy.batches_seen == STEPS * accumulate
    assert {float(state["step"]) for state in toy.named_optimizers.members["ctm"].state.values()} == {STEPS}


class Careless(Toy):
    """All parameters there are, as whoever writes a LightningModule has them."""

    def field_optimizers(self):
        return {"field": Adam(self.parameters(), LR)}


class Named(Toy):
    def field_optimizers(self):
        return {"field": Adam(self.named_parameters(), LR)}


@pytest.mark.parametrize("kind", [Careless, Named])
def test_a_field_s_optimizer_of_all_parameters_has_the_field_s_alone(kind):
    toy = kind(STEPS, small_ctm(learning=TRAINING))
    trainer(STEPS).fit(toy)
    assert same(toy.state_dict(), fit().state_dict())
    groups = toy.named_optimizers.members["field"].param_groups
    held = [id(parameter) for group in groups for parameter in group["params"]]
    assert held == [id(parameter) for parameter in toy.layer.parameters()]


def test_its_own_hyper_parameters_by_name_in_the_checkpoint(tmp_path):
    toy = fit()
    toy.trainer.save_checkpoint(tmp_path / "x.ckpt")
    saved = torch.load(tmp_path / "x.ckpt", weights_only=True)
    assert len(saved["optimizer_states"]) == 1
    state = saved["optimizer_states"][0]
    assert state.keys() == {"field", "ctm"}
    (group,) = state["ctm"]["param_groups"]
    assert (group["initial_lr"], group["betas"], group["name"]) == (0.02, (0.8, 0.95), "ctm")
    assert group["lr"] == pytest.approx(0.02 * 0.1)
    assert len(state["ctm"]["state"]) == len(list(toy.transform.parameters()))
    (group,) = state["field"]["param_groups"]
    assert (group["initial_lr"], group["betas"]) == (LR, (0.9, 0.999))
    assert isinstance(toy.named_optimizers.members["ctm"], Adam)
    assert {name for name in saved["state_dict"] if name.startswith("transform.")}


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
def test_the_transform_is_float32_under_mixed_precision(precision):
    seen = []

    class Watch(L.Callback):
        def on_before_backward(self, trainer, pl_module, loss):
            color = torch.rand(4, 3, dtype=torch.float16)
            with torch.autocast("cpu", plugin_dtype):
                seen.append(pl_module.layer(torch.rand(2, 8)).dtype)
                seen.append((pl_module.transform.encode(color).dtype, pl_module.transform.decode(color).dtype))

        def on_before_optimizer_step(self, trainer, pl_module, optimizer):
            seen.append({(p.dtype, p.grad.dtype) for p in pl_module.transform.parameters()})

    plugin_dtype = torch.bfloat16 if precision == "bf16-mixed" else torch.float16
    scaler = torch.amp.GradScaler("cpu") if precision == "16-mixed" else None
    fit(TRAINING, Watch(), steps=1, plugins=[MixedPrecision(precision, "cpu", scaler)])
    full = torch.float32
    assert seen == [plugin_dtype, (full, full), {(full, full)}]


@pytest.mark.parametrize("clip", [None, 0.5])
def test_a_gradient_scaler_skips_both_optimizers_and_unscales_them_alike(clip):
    """Against a scaler written out by hand. The field overflows in half precision; CTM, in float32, does not."""
    scale, growth, since = 2.0**20, 2, 0
    skipped, overflowing = [], []
    hand = ByHand()
    for step in range(STEPS):
        hand.set_rates(step)
        for adam in hand.adams.values():
            adam.zero_grad()
        (hand.loss(step, torch.float16) * scale).backward()
        for parameter in hand.parameters:
            parameter.grad /= scale
        finite = [all(bool(p.grad.isfinite().all()) for p in part.parameters()) for part in (hand.toy.layer, hand.ctm)]
        overflowing.append(finite)
        if not all(finite):
            skipped.append(step)
            scale, since = scale / 2, 0
            continue
        if clip is not None:
            torch.nn.utils.clip_grad_norm_(hand.parameters, clip)
        for adam in hand.adams.values():
            adam.step()
        since += 1
        if since == growth:
            scale, since = scale * 2, 0
    assert 0 < len(skipped) < STEPS - 1
    assert [False, True] in overflowing

    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**20, growth_interval=growth)
    toy = fit(plugins=[MixedPrecision("16-mixed", "cpu", scaler)], gradient_clip_val=clip)
    assert equal(toy, hand)
    assert scaler.get_scale() == scale
    assert toy.trainer.global_step == STEPS
    counts = {float(s["step"]) for adam in toy.named_optimizers.members.values() for s in adam.state.values()}
    assert counts == {STEPS - len(skipped)}


@pytest.mark.parametrize("pretrain_lr", [None, 0.5])
def test_pretraining_is_on_the_cycle_terms_with_the_same_adam(pretrain_lr):
    training = TransformTraining(lr=0.02, betas=(0.8, 0.95), lr_decay=0.1, pretrain_steps=5, pretrain_lr=pretrain_lr)
    hand = ByHand(training)
    for step in range(5):
        draws = Draws(0, step, stream="pretraining")
        hand.adams["ctm"].param_groups[0]["lr"] = 0.02 if pretrain_lr is None else 0.5 * 0.04 ** (step / 5)
        colors = hand.toy.scene_colors(draws, PRETRAIN_COLORS)
        hand.adams["ctm"].zero_grad()
        hand.ctm.cycle_loss(colors, draws.uniform).backward()
        hand.adams["ctm"].step()
    assert equal(fit(training), hand.run())


def test_pretraining_on_nothing_is_refused():
    learning = TransformTraining(pretrain_steps=5)
    ctm = small_ctm(learning=learning, weights=LossWeights(img=0.0, rand=0.0, latent=0.0))
    with pytest.raises(ConfigError, match=r"ctm\.pretrain_steps: found 5, expected 0 where"):
        trainer(1).fit(Toy(1, ctm))


class Begun(CTM):
    """Keeps what it was shown."""

    def begin(self, rgb):
        self.seen = rgb.clone()
        super().begin(rgb)


def test_a_transform_sees_the_scene_s_colours_once_before_training():
    ctm = Begun(CTMConfig(width=8, P=2))
    trainer(2).fit(Toy(2, ctm))
    assert torch.equal(ctm.seen, Toy(2).scene_colors(Draws(0, 0, stream="colors"), len(ctm.seen)))


class Drawn(ColorTransform):
    """Fitted to nothing but a draw, a space that rounding would change."""

    def __init__(self):
        super().__init__()
        self.register_buffer("turn", torch.eye(3))

    def begin(self, rgb):
        self.turn = torch.linalg.qr(torch.rand(3, 3))[0]

    def encode(self, rgb):
        assert rgb.dtype == torch.float32
        assert not torch.is_autocast_enabled("cpu")
        return rgb @ self.turn

    def decode(self, latent):
        return latent @ self.turn.T


def test_a_space_draws_by_the_seed_and_computes_in_full_precision():
    found = []
    for _ in range(2):
        torch.rand(1)
        toy = Toy(2, Drawn())
        trainer(2, precision="bf16-mixed").fit(toy)
        found.append(copied(toy.transform))
    assert same(*found)
    assert not torch.equal(found[0]["turn"], torch.eye(3))


def test_a_resumed_transform_does_not_begin_again(tmp_path):
    first = trainer(1)
    first.fit(Toy(2, small_ctm(init="range")))
    first.save_checkpoint(tmp_path / "x.ckpt")
    again = Begun(small_ctm(init="range").config)
    trainer(2).fit(Toy(2, again), ckpt_path=tmp_path / "x.ckpt", weights_only=True)
    assert not hasattr(again, "seen")


def test_a_fixed_transform_has_no_optimizer():
    toy = Toy(2, HSV())
    trainer(2).fit(toy)
    assert list(toy.named_optimizers.members) == ["field"]
    assert isinstance(toy.transform, HSV)
