"""Settings of the Trainer."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch
from lightning.pytorch.strategies import DDPStrategy

from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.build import REQUIRED, setting
from ctm_plugin.settings.check import check_choice, check_integer

CHOICES = {"accelerator": ("auto", "cpu", "gpu"), "precision": ("auto", "32-true", "bf16-mixed", "16-mixed")}


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """Device, precision, and the rhythm of curves and checkpoints; the defaults are the paper's budget.

    Raises:
        ConfigError: a value is out of range.
    """

    budget: str = setting(REQUIRED, "name of the budget")
    accelerator: str = setting("auto", "device: auto, cpu or gpu")
    devices: int = setting(1, "number of processes; they share a batch's rays")
    precision: str = setting(
        "32-true", "32-true, bf16-mixed, 16-mixed or auto; a colour transform is float32 in all of them"
    )
    accumulate_grad_batches: int = setting(1, "batches a step")
    gradient_clip_val: float | None = setting(None, "largest norm of the gradients; null: they are not clipped")
    log_every: int = setting(100, "steps between points of the curves")
    image_every: int | None = setting(
        5000,
        "steps between pictures of a test view, besides one before the first step and one after the last; null: none",
    )
    checkpoint_every: int = setting(5000, "steps between checkpoints")

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            check_choice(f"trainer.{name}", getattr(self, name), known)
        for name in ("devices", "accumulate_grad_batches", "log_every", "checkpoint_every"):
            check_integer(f"trainer.{name}", getattr(self, name), 1)
        if self.image_every is not None and self.image_every < 1:
            raise ConfigError("trainer.image_every", self.image_every, "an integer >= 1, or null")
        if self.gradient_clip_val is not None and not self.gradient_clip_val > 0:
            raise ConfigError("trainer.gradient_clip_val", self.gradient_clip_val, "a number > 0, or null")

    @property
    def backend(self) -> str:
        """What trains, ``cuda`` or ``cpu``: Lightning would take Apple's GPUs as well, which have no float64."""
        found = self.accelerator == "auto" and torch.cuda.is_available()
        return "cuda" if found or self.accelerator == "gpu" else "cpu"

    @property
    def numbers(self) -> str:
        """The precision, with ``auto`` settled: ``bf16-mixed`` where the device multiplies bf16 itself, else float32.

        Raises:
            ConfigError: ``16-mixed`` without a GPU, where Lightning would take bf16 in its place.
        """
        gpu = self.accelerator != "cpu" and torch.cuda.is_available()
        if self.precision == "16-mixed" and not gpu:
            raise ConfigError("trainer.precision", self.precision, "bf16-mixed or 32-true on a CPU")
        if self.precision not in ("auto", "bf16-mixed"):
            return self.precision
        features = {} if gpu else torch.cpu.get_capabilities()
        if gpu:
            fast = torch.cuda.is_bf16_supported(including_emulation=False)
        else:
            fast = features.get("avx512_bf16", False) or features.get("amx_bf16", False)
        if self.precision == "auto":
            return "bf16-mixed" if fast else "32-true"
        if not fast and not features.get("bf16"):  # ARM's name for it
            warnings.warn(
                f"trainer.precision=bf16-mixed: this {'GPU' if gpu else 'processor'} does not multiply bf16 itself; "
                "float32 (32-true, which auto would take) may be many times faster",
                stacklevel=1,  # once a process, however many ask
            )
        return self.precision

    @property
    def strategy(self) -> str | DDPStrategy:
        """One process, or one a device with gradients averaged.

        Parts of a model may rest in a step. Buffers follow from the data and the parameters, which all processes share:
        sending them every step, training pixels and all, would cost more than the step.
        """
        return "auto" if self.devices == 1 else DDPStrategy(find_unused_parameters=True, broadcast_buffers=False)
