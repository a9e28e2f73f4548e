"""A LightningModule that knows nothing of this package but ``ctm.losses`` learns a dark picture in learned colours."""

import lightning as L
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader, TensorDataset
from toy import trainer

import ctm_plugin as ctm
from ctm_plugin.errors import CTMError

SIDE = 24
EPOCHS = 30


def picture(brightest: float = 0.04) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions ``[N, 2]`` in [-1, 1] and dark colours ``[N, 3]``."""
    axis = torch.linspace(-1, 1, SIDE)
    x, y = torch.meshgrid(axis, axis, indexing="xy")
    rgb = brightest * torch.stack([x, y, torch.sin(4 * x) * y], dim=-1).add(1).div(2)
    return torch.stack([x, y], dim=-1).flatten(0, 1), rgb.flatten(0, 1)


class CoordinateMLP(L.LightningModule):
    """A picture as a network from places to colours, as anyone writes it; ``transform`` is not its business to make."""

    def __init__(self, channels: int = 3, frequencies: int = 4, width: int = 32, lr: float = 5e-3):
        super().__init__()
        self.lr = lr
        self.register_buffer("waves", 2.0 ** torch.arange(frequencies), persistent=False)
        torch.manual_seed(0)
        self.mlp = nn.Sequential(
            nn.Linear(2 + 4 * frequencies, width), nn.ReLU(),
            nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, channels), nn.Sigmoid(),
        )  # fmt: skip

    def forward(self, xy):
        angles = (xy[..., None] * self.waves).flatten(-2)
        return self.mlp(torch.cat([xy, angles.sin(), angles.cos()], dim=-1))

    def training_step(self, batch, batch_idx):
        xy, rgb = batch
        terms = ctm.losses(self.transform, self(xy), rgb)
        self.log_dict({f"loss/{name}": term for name, term in terms.items()})
        return sum(terms.values())

    def validation_step(self, batch, batch_idx):
        xy, rgb = batch
        error = (self.transform.decode(self(xy)) - rgb).square().mean()
        self.log("val/psnr", -10 * error.log10())

    def configure_optimizers(self):
        return torch.optim.Adam(self.parameters(), self.lr)


def loader() -> DataLoader:
    generator = torch.Generator().manual_seed(0)
    return DataLoader(TensorDataset(*picture()), batch_size=192, shuffle=True, generator=generator)


def fit(module: CoordinateMLP, *callbacks: L.Callback, transform=None, epochs: int = EPOCHS, **more) -> L.Trainer:
    transform = transform or ctm.transform("quick", "ctm.k=4", "ctm.pretrain_steps=200")
    attach = ctm.AttachTransform(transform, picture()[1].repeat(20, 1))
    made = trainer(-1, attach, *callbacks, max_epochs=epochs, limit_val_batches=1)
    data = DataLoader(TensorDataset(*picture()), batch_size=SIDE**2)
    made.fit(module, loader(), data, weights_only=True, **more)
    return made


def test_it_learns_with_two_optimizers_under_one_step():
    module = CoordinateMLP(channels=4)
    made = fit(module)
    members = made.optimizers[0].members
    assert members.keys() == {"field", "ctm"}
    held = {id(parameter) for group in members["field"].param_groups for parameter in group["params"]}
    assert held == {id(parameter) for parameter in module.mlp.parameters()}
    steps = EPOCHS * SIDE**2 // 192
    assert made.global_step == steps
    assert {float(state["step"]) for state in members["ctm"].state.values()} == {200.0 + steps}
    flat = -10 * (picture()[1] - picture()[1].mean(0)).square().mean().log10()
    assert made.callback_metrics["val/psnr"] > flat + 3  # more than one colour for all
    assert "configure_optimizers" not in vars(module)


@pytest.mark.slow
def test_its_checkpoint_goes_on_and_nothing_is_fitted_anew(tmp_path, monkeypatch):
    made = fit(CoordinateMLP(channels=4), epochs=2)
    made.save_checkpoint(tmp_path / "x.ckpt")
    saved = torch.load(tmp_path / "x.ckpt", weights_only=True)
    assert saved["optimizer_states"][0].keys() == {"field", "ctm"}
    monkeypatch.setattr("ctm_plugin.callbacks.attach_ctm.prepare", lambda *given: pytest.fail("fitted anew"))
    again = CoordinateMLP(channels=4)
    fit(again, epochs=2, ckpt_path=tmp_path / "x.ckpt")
    own = {name: value for name, value in saved["state_dict"].items() if name.startswith("transform.")}
    assert own
    assert all(torch.equal(again.state_dict()[name], value) for name, value in own.items())


def test_a_fixed_transform_leaves_its_optimizer_alone():
    made = fit(CoordinateMLP(), transform=ctm.transform("auto"), epochs=1)
    assert type(made.optimizers[0]).__name__ == "Adam"
    assert float(made.lightning_module.transform.level) < 0.04  # it was fitted


class Scheduled(CoordinateMLP):
    def configure_optimizers(self):
        adam = super().configure_optimizers()
        return [adam], [torch.optim.lr_scheduler.StepLR(adam, 1)]


def test_schedulers_of_its_own_are_refused():
    with pytest.raises(CTMError, match="configure_optimizers: found tuple, expected one optimizer, no scheduler"):
        fit(Scheduled(channels=4), epochs=1)
