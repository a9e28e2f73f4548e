"""The settings of trainings, and those of every verb on runs; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ctm_plugin.color.settings import LightConfig
from ctm_plugin.settings.setting import REQUIRED, Settings, setting


@dataclass(frozen=True, kw_only=True)
class TrainerConfig(Settings, section="trainer"):
    """Device, precision, and the rhythm of curves and checkpoints; the defaults are the paper's budget."""

    budget: str = setting(REQUIRED, "name of the budget")
    accelerator: str = setting("auto", "device: auto, cpu or gpu", choices=("auto", "cpu", "gpu"))
    devices: int = setting(1, "number of processes; they share a batch's rays", least=1)
    precision: str = setting(
        "32-true",
        "32-true, bf16-mixed, 16-mixed or auto; a colour transform is float32 in all of them",
        choices=("auto", "32-true", "bf16-mixed", "16-mixed"),
    )
    accumulate_grad_batches: int = setting(1, "batches a step", least=1)
    gradient_clip_val: float | None = setting(
        None, "largest norm of the gradients; null: they are not clipped", above=0
    )
    log_every: int = setting(100, "steps between points of the curves", least=1)
    image_every: int | None = setting(
        5000,
        "steps between pictures of a test view, besides one before the first step and one after the last; null: none",
        least=1,
    )
    checkpoint_every: int = setting(5000, "steps between checkpoints", least=1)
    minutes: float | None = setting(
        None,
        "minutes that training takes: its schedule is stretched or cut to end then, of splats; null: all its steps",
        above=0,
    )

    @property
    def backend(self) -> str:
        """Device that trains, ``cuda`` or ``cpu``: Lightning would take Apple's GPUs as well, which have no float64."""
        import torch

        available = self.accelerator == "auto" and torch.cuda.is_available()
        return "cuda" if available or self.accelerator == "gpu" else "cpu"

    @property
    def numbers(self) -> str:
        """The precision, with ``auto`` settled: ``bf16-mixed`` where the device multiplies bf16 itself, else float32.

        Raises:
            ConfigError: ``16-mixed`` without a GPU, where Lightning would take bf16 in its place.
        """
        import torch

        gpu = self.accelerator != "cpu" and torch.cuda.is_available()
        if self.precision == "16-mixed" and not gpu:
            raise self.fault("precision", "bf16-mixed or 32-true on a CPU")
        if self.precision != "auto":
            return self.precision
        if gpu:
            fast = torch.cuda.is_bf16_supported(including_emulation=False)
        else:
            features = torch.cpu.get_capabilities()
            fast = features.get("avx512_bf16", False) or features.get("amx_bf16", False)
        return "bf16-mixed" if fast else "32-true"

    @property
    def strategy(self) -> Any:
        """Lightning's strategy: one process, or DDP with one process a device.

        Parts of a model may be unused in a step. Buffers follow from the data and the parameters, which all processes
        share: sending them every step, training pixels included, would cost more than the step.
        """
        from lightning.pytorch.strategies import DDPStrategy

        return "auto" if self.devices == 1 else DDPStrategy(find_unused_parameters=True, broadcast_buffers=False)


@dataclass(frozen=True, kw_only=True)
class DataFolder(Settings, section="dataset"):
    """Folder of a run's data."""

    root: str | None = setting(None, "folder with the run's data, if they have been moved")


@dataclass(frozen=True, kw_only=True)
class RunConfig(Settings):
    """Settings of a run that is read again."""

    dataset: DataFolder = DataFolder()


@dataclass(frozen=True, kw_only=True)
class LitConfig(LightConfig, RunConfig):
    """Settings of a run whose pictures are shown as bright as in normal light."""
