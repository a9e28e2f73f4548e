"""From a resolved configuration to the objects of a run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import lightning as L

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.attach_ctm import AttachTransform, TransformTraining
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import Chain, ColorTransform
from ctm_plugin.draws import seeded
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.loggers.base import RunLogger
from ctm_plugin.metrics.lpips_weights import MetricsConfig
from ctm_plugin.metrics.table import add_others
from ctm_plugin.runs.trainer import TrainerConfig
from ctm_plugin.settings.build import SECTIONS, Config, build, split, unknown_key
from ctm_plugin.settings.check import check_integer
from ctm_plugin.settings.registry import APPEARANCES, BACKBONES, CALLBACKS, COLOR_SPACES, DATASETS, LOGGERS, TRANSFORMS


@dataclass
class Parts:
    """What a run is made of."""

    scene: Any
    backbone: Backbone
    attach: AttachTransform
    trainer: TrainerConfig
    metrics: MetricsConfig
    loggers: list[RunLogger] = field(default_factory=list)
    callbacks: list[L.Callback] = field(default_factory=list)


def assemble(config: Config, run: Path | None = None, step: int = 0, scene: Any = None) -> Parts:
    """Build everything a configuration names, checking all of it before any data is read.

    Args:
        config: the resolved configuration.
        run: the directory of a run that is to be trained, from ``step`` on. Loggers and callbacks are only built for
            it: scoring does not need their packages.
        scene: takes the place of the configuration's, whose data are gone.

    Raises:
        CTMError: on anything that cannot be used, naming the key or the file.
    """
    check_keys(config)
    add_others()
    seed = config["seed"]
    check_integer("seed", seed, 0)
    trainer = build(TrainerConfig, config["trainer"], "trainer")
    metrics = build(MetricsConfig, config["metrics"], "metrics")
    photometric = build(Photometric, config["loss"], "loss")
    transform, training = color_transform(config, seed)
    backbone = BACKBONES.get(_name(config["backbone"]))
    backbone_config = build(backbone.Config, _settings(config["backbone"]), "backbone")
    appearance = _appearance(config["appearance"])
    if appearance and not backbone.posed:
        expected = f"none: backbone={_name(config['backbone'])} has no pictures that cameras took"
        raise ConfigError("appearance", _name(config["appearance"]), expected)
    observers = ([], []) if run is None else (loggers(config, run, step), callbacks(config))
    scene = load_scene(config) if scene is None else scene
    if not isinstance(scene, backbone.Scene):
        expected = f"a data set that backbone={_name(config['backbone'])} can train on (a {backbone.Scene.__name__})"
        if others := " or ".join(f"backbone={name}" for name in _made_for(scene)):
            expected += f"; this one is for {others}"
        raise ConfigError("dataset", _name(config["dataset"]), expected)
    module = backbone(backbone_config, scene, transform.channels, photometric, seed)
    if appearance:
        kind, settings = appearance
        module.appearance = kind(settings, scene.train)
    return Parts(scene, module, AttachTransform(transform, training), trainer, metrics, *observers)


def _made_for(scene: Any) -> Iterator[str]:
    """Find the backbones that train on a scene, but for other packages' that cannot be imported."""
    for name in BACKBONES.names():
        with suppress(CTMError):
            if isinstance(scene, BACKBONES.get(name).Scene):
                yield name


def loggers(config: Config, run: Path, step: int) -> list[RunLogger]:
    """Build what a run's curves and pictures go to; ``step`` is what it goes on from.

    Raises:
        CTMError: on settings that cannot be used, or where its package is missing.
    """
    node = config["logger"]
    if node.get("name") == "none":
        _no_settings(node, "logger")
        return []
    kind = LOGGERS.get(_name(node))
    settings = build(kind.Config, _settings(node), "logger")
    try:
        return [kind(settings, run, step)]
    except ModuleNotFoundError as error:
        expected = f"an installed package ({error}): pip install -e '.[{_name(node)}]'"
        raise ConfigError("logger", _name(node), expected) from error


def callbacks(config: Config) -> list[L.Callback]:
    """Build the callbacks that a configuration names, in its order.

    Raises:
        CTMError: on a name that is not known, or settings that cannot be used.
    """
    named = {name: node for name, node in config["callbacks"].items() if node is not None}
    for name, node in named.items():
        if not isinstance(node, Mapping):
            raise ConfigError(f"callbacks.{name}", node, "settings, or null for none of it")
    return [build(CALLBACKS.get(name), node, f"callbacks.{name}") for name, node in named.items()]


def check_keys(config: Config) -> None:
    """Refuse a configuration with keys that mean nothing, or without one that is needed.

    Raises:
        ConfigError: there is such a key.
    """
    known = (*SECTIONS, "seed", "resume")
    for key in config:
        if key not in known:
            raise unknown_key(key, known)
    for key in known:
        if key not in config or (key in SECTIONS and not isinstance(config[key], Mapping)):
            raise ConfigError(key, config.get(key), "settings" if key in SECTIONS else "a value")
    if config["resume"] is not None:
        raise ConfigError("resume", config["resume"], "null: a run goes on only by resume=RUN_DIR on the command line")


def load_scene(config: Config) -> Any:
    """Load the data set that a configuration names."""
    dataset = DATASETS.get(_name(config["dataset"]))
    return build(dataset, _settings(config["dataset"]), "dataset").load()


def color_transform(config: Config, seed: int) -> tuple[ColorTransform, TransformTraining]:
    """Build the fixed space with the learned transform on top of it, and how the latter is trained."""
    space = _color_space(config["color_space"], seed)
    node = config["ctm"]
    if node.get("name") == "none":
        _no_settings(node, "ctm")
        return space, TransformTraining()
    kind = TRANSFORMS.get(_name(node))
    training, rest = split(_settings(node), TransformTraining, kind.Config)
    known = [each.name for settings in (TransformTraining, kind.Config) for each in fields(settings)]
    for name in rest:
        if name not in known:
            raise unknown_key(f"ctm.{name}", known)
    training = build(TransformTraining, training, "ctm")
    settings = build(kind.Config, rest, "ctm")
    with seeded(seed):
        learned = kind(settings)
    learned.label = f"ctm={node.get('preset', _name(node))}"
    if _name(config["color_space"]) == "rgb":
        return learned, training
    if space.channels != 3:
        raise ConfigError("color_space", _name(config["color_space"]), f"one of 3 channels under {learned.label}")
    return Chain(space, learned), training


def _color_space(node: Config, seed: int) -> ColorTransform:
    kind = COLOR_SPACES.get(_name(node))
    if not fields(kind.Config):
        _no_settings(node, "color_space")
    settings = build(kind.Config, _settings(node), "color_space")
    with seeded(seed):
        space = kind(settings)
    space.label = f"color_space={_name(node)}"
    if any(True for _ in space.parameters()):
        raise ConfigError("color_space", _name(node), "one without parameters: a space that learns is a ctm")
    return space


def _appearance(node: Config) -> tuple[type, Any] | None:
    """The class of a configuration's appearance and its settings; ``None`` where there is none."""
    if node.get("name") == "none":
        _no_settings(node, "appearance")
        return None
    kind = APPEARANCES.get(_name(node))
    return kind, build(kind.Config, _settings(node), "appearance")


def _name(node: Config) -> str:
    return str(node.get("name"))


def _no_settings(node: Config, group: str) -> None:
    for key, value in _settings(node).items():
        raise ConfigError(f"{group}.{key}", value, f"no such key: {group}={_name(node)} has no settings")


def _settings(node: Config) -> dict[str, Any]:
    """A group's own settings: without the name it is registered under and the preset it came from."""
    return {key: value for key, value in node.items() if key not in ("name", "preset")}
