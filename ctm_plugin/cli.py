"""The command line: ``python -m ctm_plugin [+]group=choice key=value ...``, or ``ctm`` for short."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ctm_plugin.errors import CTMError
from ctm_plugin.registry import BACKBONES, DATASETS, TRANSFORMS

GROUPS = ("dataset", "backbone", "ctm", "color_space", "loss", "trainer", "experiment")


def conf_dir() -> Path:
    """``conf/`` inside the package, where a wheel puts it, or beside it, in a checkout."""
    package = Path(__file__).resolve().parent
    inside, beside = package / "conf", package.parent / "conf"
    return inside if inside.is_dir() else beside


def normalise(arguments: Iterable[str]) -> list[str]:
    """Take the ``+`` off group choices: every group has a default, so that ``+backbone=dvgo`` would be a second choice.

    Only a single ``+`` before a group's own name goes: ``++x=1``, ``~group`` and ``+group.key=v`` pass.

    Example:
        >>> normalise(["+backbone=dvgo", "+backbone.width=3", "-m"])
        ['backbone=dvgo', '+backbone.width=3', '-m']
    """
    prefixes = tuple(f"+{group}=" for group in GROUPS)
    return [argument[1:] if argument.startswith(prefixes) else argument for argument in arguments]


def register_plugins() -> None:
    """Give every name of another package that has no file in ``conf/`` a config of its settings' defaults."""
    store = ConfigStore.instance()
    for group, registry in (("backbone", BACKBONES), ("dataset", DATASETS), ("ctm", TRANSFORMS)):
        for name in {*registry.others(), *registry.added}:
            thing = registry.get(name)
            settings = getattr(thing, "Config", thing)
            node = {"name": name, **OmegaConf.to_container(OmegaConf.structured(settings))}
            if group == "ctm":
                node["preset"] = name
            store.store(group=group, name=name, node=node)


def resolved(config: DictConfig) -> dict[str, Any]:
    """The configuration as plain containers, without Hydra's own part."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=False)


@hydra.main(version_base="1.3", config_path=None, config_name="config")
def run(config: DictConfig) -> float | None:
    """One job, single or of a sweep; returns its PSNR, for sweepers that search."""
    from ctm_plugin.train import train

    result = train(resolved(config), Path(HydraConfig.get().runtime.output_dir))
    return result.get("psnr")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; every error of a user's is one message and a non-zero exit.

    Returns:
        The exit code: 0, 1 on an error, 130 when interrupted after saving.
    """
    arguments = normalise(sys.argv[1:] if arguments is None else arguments)
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")  # let its exceptions reach us
    try:
        register_plugins()
        resuming = [argument for argument in arguments if argument.startswith("resume=")]
        if resuming and resuming != ["resume=null"]:
            return _resume(arguments)
        sys.argv = ["ctm_plugin", "--config-dir", str(conf_dir()), *arguments]
        run()
    except CTMError as error:
        from ctm_plugin.train import Interrupted

        print(f"{error}" if isinstance(error, Interrupted) else f"error: {error}", file=sys.stderr)
        return 130 if isinstance(error, Interrupted) else 1
    except (HydraException, OmegaConfBaseException) as error:
        print(f"error: {explain(error)}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {error.filename}: {error.strerror}, expected to read or write it", file=sys.stderr)
        return 1
    return 0


def _resume(arguments: Sequence[str]) -> int:
    from ctm_plugin.train import resume

    if len(arguments) > 1:
        others = [argument for argument in arguments if not argument.startswith("resume=")]
        raise CTMError(
            f"resume: found {' '.join(others)} beside it, expected nothing: a run goes on with its own settings"
        )
    resume(Path(arguments[0].removeprefix("resume=")))
    return 0


def explain(error: Exception) -> str:
    """Hydra's message, with the known keys where one is unknown."""
    message = str(error).strip()
    cause = error.__cause__ or error
    full_key = getattr(cause, "full_key", None)
    parent = getattr(cause, "parent_node", None)
    if full_key and isinstance(parent, DictConfig) and "not in struct" in str(cause):
        known = ", ".join(sorted(str(key) for key in parent if key != "hydra"))
        return f"{full_key}: found an unknown key, expected one of {known}"
    return message
