"""A run directory: what is in it, and reading it without trusting it."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ctm_plugin.assemble import GROUPS, Config
from ctm_plugin.errors import CheckpointError

CONFIG, METRICS, LAST = "config.yaml", "metrics.json", "checkpoints/last.ckpt"


def save_config(run: Path, config: Config) -> None:
    """Write the resolved configuration into a run directory, made if need be."""
    run.mkdir(parents=True, exist_ok=True)
    (run / CONFIG).write_text(OmegaConf.to_yaml(OmegaConf.create(dict(config))), encoding="utf-8")


def load_config(run: Path) -> dict[str, Any]:
    """The configuration of a run, as plain containers: nothing in it is interpreted.

    Raises:
        CheckpointError: the folder is no run directory, or its configuration cannot be read.
    """
    path = run / CONFIG
    if not run.is_dir():
        raise CheckpointError(run, "no such directory", "a run directory")
    if not path.is_file():
        raise CheckpointError(run, f"no {CONFIG}", "a run directory")
    try:
        config = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except (OSError, UnicodeDecodeError, YAMLError, OmegaConfBaseException) as error:
        raise CheckpointError(path, f"no readable YAML ({type(error).__name__})", "a run's configuration") from error
    missing = [name for name in GROUPS if not isinstance(config, dict) or not isinstance(config.get(name), dict)]
    if missing or "seed" not in config:
        raise CheckpointError(path, f"nothing for {', '.join(missing) or 'seed'}", "a run's configuration")
    return config


def load_checkpoint(run: Path, config: Config) -> dict[str, Any]:
    """The last checkpoint of a run, read with ``weights_only=True``.

    Raises:
        CheckpointError: there is none, it cannot be read, or it was made with another configuration.
    """
    path = run / LAST
    if not path.is_file():
        raise CheckpointError(run, f"no {LAST}", "a checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            if damaged := archive.testzip():  # torch does not compare the check sums
                raise zipfile.BadZipFile(damaged)
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # unpicklers raise anything on a damaged file
        raise CheckpointError(path, f"an unreadable file ({type(error).__name__})", "a checkpoint") from error
    if not isinstance(checkpoint, dict) or not {"state_dict", "config", "batches_seen"} <= checkpoint.keys():
        raise CheckpointError(path, "a file of another kind", "a checkpoint of ctm_plugin")
    differing = differences(checkpoint["config"], config)
    if differing:
        raise CheckpointError(
            path, f"another configuration (differs in {', '.join(differing)})", f"that of {run / CONFIG}"
        )
    return checkpoint


def differences(a: Any, b: Any, key: str = "") -> list[str]:
    """Keys at which two configurations differ."""
    if isinstance(a, dict) and isinstance(b, dict):
        prefix = f"{key}." if key else ""
        return [found for k in sorted({*a, *b}) for found in differences(a.get(k), b.get(k), f"{prefix}{k}")]
    return [] if a == b else [key]
