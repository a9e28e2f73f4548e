"""The settings of trainings and of the verbs on runs; torch is not needed to check them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ctm_plugin.color.settings import LightConfig
from ctm_plugin.errors import ConfigError
from ctm_plugin.settings.setting import REQUIRED, Settings, setting

CAMERA_PATHS = ("capture", "orbit", "spiral", "test")
"""Names of camera paths."""
EXPORTS = ("splats", "points", "mesh", "cameras", "pictures", "page")
"""Names of the kinds of exports of a run."""


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


@dataclass(frozen=True, kw_only=True)
class ExportConfig(LitConfig):
    """Kind and resolution of an export."""

    what: str | None = setting(
        None,
        "splats, points or mesh (.ply), cameras (with photographs), pictures (lit) or "
        "page; null: splats where there are some, else points",
        choices=EXPORTS,
    )
    out: str | None = setting(None, "folder to write to; null: RUN_DIR/export, of what=page RUN_DIR")
    points: int = setting(200_000, "largest number of points", least=1)
    cells: int = setting(128, "cells of the mesh along its longest side", least=2, most=2048)
    opaque: float = setting(
        0.5,
        "share of light that a point's ray stops, or that a hundredth of the mesh's side stops at its surface",
        above=0,
        below=1,
    )
    photographs: bool = setting(False, "of what=pictures: the photographs, lit, in place of renderings")
    overwrite: bool = setting(False, "replace existing files")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.photographs and self.what != "pictures":
            raise self.fault("photographs", "false, or what=pictures")


@dataclass(frozen=True, kw_only=True)
class VideoConfig(LitConfig):
    """Path and pictures of a film."""

    light: str | None = setting(
        None,
        "brightening: auto, a number of stops, or off, see ctm evaluate --help; null: as a viewer's .json says, else "
        "auto",
    )
    path: str | None = setting(
        None,
        "capture (past the photographs' places), orbit, spiral, test (test cameras) or a viewer's .json; null: "
        "orbit where cameras surround the scene, else capture",
    )
    what: str = setting(
        "lit", "lit (lit pictures), or all (lit, dark, depth and latent side by side)", choices=("lit", "all")
    )
    frames: int = setting(120, "number of frames, of all paths but test", least=1)
    fps: int = setting(24, "frames a second", least=1)
    out: str | None = setting(
        None, "file to write, .mp4, .webp or .gif; null: RUN_DIR/video/PATH.mp4, or .gif without the extra video"
    )
    overwrite: bool = setting(False, "replace existing videos")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is not None and not self.path.endswith(".json") and self.path not in CAMERA_PATHS:
            raise self.fault("path", f"one of {', '.join(CAMERA_PATHS)}, FILE.json")
        if self.out is not None and (suffix := Path(self.out).suffix) not in (".gif", ".mp4", ".webp"):
            raise ConfigError("out", suffix, "one of .gif, .mp4, .webp")
        if self.out is not None and suffix == ".mp4" and not can_mp4():
            raise self.fault("out", "a .gif, or pip install -e '.[video]'")


def can_mp4() -> bool:
    return find_spec("imageio_ffmpeg") is not None


@dataclass(frozen=True, kw_only=True)
class PhotosConfig(Settings):
    """Settings of ``ctm photos``: the time that it may take."""

    minutes: float = setting(
        10.0,
        "minutes of training on this machine, approximately; the pictures' size and the budget follow from it",
        above=0,
    )
    again: bool = setting(False, "train again, in a new folder, although there is a finished run of this folder")


@dataclass(frozen=True, kw_only=True)
class MetricsConfig(Settings, section="metrics"):
    """Scores of test views."""

    lpips_weights: str | Path | None = setting(
        None, "file (.npz or .pth) with AlexNet's or VGG's convolutions; null: torch.hub's cache, else a download"
    )
    lpips_net: str = setting("alex", "network that LPIPS compares with: alex or vgg", choices=("alex", "vgg"))


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Settings):
    """Settings of ``ctm report``: metrics, tables and formats."""

    table: int | None = setting(
        None, "number of the paper's table to show, 1 to 19; null: all runs, and the paper's tables that they fill"
    )
    data: str | None = setting(
        None,
        "name of the paper's data set whose values are shown next to runs of other data, such as Synthetic-NeRF-Dark",
    )
    format: str = setting("md", "format of tables: md, csv or html", choices=("md", "csv", "html"))
    out: str | None = setting(None, "file to write; null: standard output, report.html for html")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.out is not None and not Path(self.out).name:
            raise self.fault("out", "the name of a file")


@dataclass(frozen=True, kw_only=True)
class ViewConfig(LitConfig):
    """Port and first light of the viewer."""

    port: int = setting(8080, "port of the page", least=1, most=65535)
