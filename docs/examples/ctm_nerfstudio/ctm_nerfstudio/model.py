"""Nerfacto that renders ``channels`` numbers a ray, with a colour transform between the photographs and its loss."""

from dataclasses import dataclass, field

import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.field_components.mlp import MLP
from nerfstudio.model_components import renderers
from nerfstudio.models.nerfacto import NerfactoModel, NerfactoModelConfig
from nerfstudio.utils.colors import COLORS_DICT
from torch import Tensor, nn

import ctm_plugin as ctm


@dataclass
class CTMNerfactoConfig(NerfactoModelConfig):
    """Nerfacto's settings, and its colours."""

    _target: type = field(default_factory=lambda: CTMNerfacto)
    colors: tuple[str, ...] = ("auto",)
    """What ``ctm_plugin.transform`` takes: quick ctm.k=4."""


class LatentRenderer(renderers.RGBRenderer):
    """Adds up latents of any number of channels over encoded backgrounds."""

    def __init__(self, background_color: str, transform: nn.Module):
        super().__init__(background_color)
        self.held = (transform,)  # in a tuple: the module tree has it already

    def forward(self, rgb: Tensor, weights: Tensor, **_) -> Tensor:
        """``rgb`` ``[R, S, k]`` and ``weights`` ``[R, S, 1]`` to ``[R, k]``."""
        latent = (weights * rgb).sum(-2)
        behind = self.behind(rgb)
        if behind is not None:
            latent = latent + behind * (1 - weights.sum(-2))
        return latent if self.training else latent.nan_to_num().clamp(0, 1)

    def behind(self, samples: Tensor) -> Tensor | None:
        """The latent behind the scene; ``None`` where the loss puts a random one there."""
        color = renderers.BACKGROUND_COLOR_OVERRIDE  # the viewer's, where it asks for one
        if color is None and self.background_color == "last_sample":
            return samples[..., -1, :]
        if color is None and self.background_color == "random" and self.training:
            return None
        if color is None:
            color = COLORS_DICT.get(self.background_color, torch.zeros(3))  # random: black, as nerfstudio has it
        return self.held[0].encode(color.to(samples).expand(1, 3))

    def blend_background_for_loss_computation(
        self, pred_image: Tensor, pred_accumulation: Tensor, gt_image: Tensor
    ) -> tuple[Tensor, Tensor]:
        """A batch's latents, and its photographs, which may be transparent; random backgrounds are as the scene is."""
        if self.background_color != "random" or not self.training:
            return pred_image, self.blend_background(gt_image)
        (transform,) = self.held
        with torch.no_grad():
            low, high = transform.filled
            color = transform.decode(low + (high - low) * torch.rand_like(pred_image))
            behind = transform.encode(color)
        return pred_image + behind * (1 - pred_accumulation), self.blend_background(gt_image, color)


class ColorLoss(nn.Module):
    """A transform's losses in the place of nerfacto's squared difference; ``terms`` has them by name."""

    def __init__(self, transform: nn.Module):
        super().__init__()
        self.held = (transform,)

    def forward(self, rgb: Tensor, latent: Tensor) -> Tensor:
        self.terms = ctm.losses(self.held[0], latent, rgb)
        return sum(self.terms.values())


class CTMNerfacto(NerfactoModel):
    """Nerfacto whose ``rgb`` is decoded from what it renders, ``latent``."""

    config: CTMNerfactoConfig

    def populate_modules(self) -> None:
        super().populate_modules()
        name, *keys = self.config.colors
        self.transform = ctm.transform(name.removeprefix("ctm="), *keys)
        head = self.field.mlp_head
        self.field.mlp_head = MLP(
            head.in_dim, head.num_layers, head.layer_width, self.transform.channels,
            activation=head.activation, out_activation=head.out_activation, implementation=self.config.implementation,
        )  # fmt: skip
        self.renderer_rgb = LatentRenderer(self.config.background_color, self.transform)
        self.rgb_loss = ColorLoss(self.transform)

    def get_param_groups(self) -> dict[str, list]:
        groups = super().get_param_groups()
        if parameters := list(self.transform.parameters()):
            learning = self.transform.learning
            groups["ctm"] = [{"params": parameters, "lr": learning.lr, "betas": learning.betas}]
        return groups

    def get_training_callbacks(self, attributes: TrainingCallbackAttributes) -> list[TrainingCallback]:
        if attributes.trainer.world_size > 1 and any(True for _ in self.transform.parameters()):
            found = attributes.trainer.world_size
            raise ValueError(f"machine.num_devices: found {found}, expected 1 for a transform that learns")
        begin = TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], self.begin, args=[attributes])
        return [begin, *super().get_training_callbacks(attributes)]

    def begin(self, attributes: TrainingCallbackAttributes, step: int) -> None:
        """Fit the transform to training colours, before the first step of all: a checkpoint has what was found."""
        if step == 0:
            pixels = self.training_colors(attributes.pipeline.datamanager, 1 << 15)
            ctm.fit(self.transform, pixels, optimizer=attributes.optimizers.optimizers.get("ctm"))
            if layers := getattr(self.field.mlp_head, "layers", None):  # tcnn's have no biases
                # The scene's mean: from grey the first steps would drive the sigmoid to where it has no gradient.
                mean = self.transform.encode(pixels).mean(0).detach()
                layers[-1].bias.data.copy_(mean.logit(eps=1e-3))

    def training_colors(self, datamanager, least: int) -> Tensor:
        """``[N, 3]``, at least so many: of batches, so that masks and samplers are heeded."""
        found: list[Tensor] = []
        while sum(map(len, found)) < least:
            image = datamanager.next_train(0)[1]["image"].to(self.device)
            found.append(self.renderer_rgb.blend_background(image))
        return torch.cat(found)

    def get_outputs(self, ray_bundle) -> dict:
        outputs = super().get_outputs(ray_bundle)
        latent = outputs["rgb"]
        with torch.no_grad():
            outputs["rgb"] = self.transform.decode(latent.float()).clamp(0, 1)
        # In a list, which the viewer does not offer as a picture.
        return outputs | {"latents": [latent]}

    def get_loss_dict(self, outputs, batch, metrics_dict=None) -> dict[str, Tensor]:
        (latent,) = outputs["latents"]
        losses = super().get_loss_dict(outputs | {"rgb": latent}, batch, metrics_dict)
        del losses["rgb_loss"]  # the sum of these
        return losses | {f"{name}_loss": term for name, term in self.rgb_loss.terms.items()}
