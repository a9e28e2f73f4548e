"""From a resolved configuration to the objects of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ctm_plugin.backbones.base import Backbone
from ctm_plugin.callbacks.ctm import AttachTransform, TransformTraining
from ctm_plugin.color.loss import Photometric
from ctm_plugin.color.transform import Chain, ColorSpace, ColorTransform
from ctm_plugin.config import build, split
from ctm_plugin.data.scene import Scene
from ctm_plugin.draws import seeded
from ctm_plugin.errors import ConfigError
from ctm_plugin.registry import BACKBONES, DATASETS, TRANSFORMS

Config = Mapping[str, Any]


@dataclass
class Parts:
    """What a run is made of."""

    scene: Scene
    backbone: Backbone
    attach: AttachTransform


def assemble(config: Config) -> Parts:
    """Build everything a configuration names, checking all of it before any data is read.

    Raises:
        CTMError: on anything that cannot be used, naming the key or the file.
    """
    seed = config["seed"]
    if not isinstance(seed, int) or seed < 0:
        raise ConfigError("seed", seed, "an integer >= 0")
    photometric = build(Photometric, config["loss"], "loss")
    transform, training = color_transform(config, seed)
    backbone = BACKBONES.get(config["backbone"]["name"])
    backbone_config = build(backbone.Config, _settings(config["backbone"]), "backbone")
    scene = load_scene(config)
    module = backbone(backbone_config, scene, transform.channels, photometric, seed)
    return Parts(scene, module, AttachTransform(transform, training))


def load_scene(config: Config) -> Scene:
    """The data set that a configuration names."""
    dataset = DATASETS.get(config["dataset"]["name"])
    return build(dataset, _settings(config["dataset"]), "dataset").load()


def color_transform(config: Config, seed: int) -> tuple[ColorTransform, TransformTraining]:
    """The handcrafted space with the learned transform on top of it, and how the latter is trained."""
    space = ColorSpace(config["color_space"]["name"])
    node = config["ctm"]
    if node["name"] == "none":
        return space, build(TransformTraining, {}, "ctm")
    kind = TRANSFORMS.get(node["name"])
    training, rest = split(_settings(node), TransformTraining, kind.Config)
    training = build(TransformTraining, training, "ctm")
    settings = build(kind.Config, rest, "ctm")
    with seeded(seed):
        learned = kind(settings)
    return (learned if space.name == "rgb" else Chain(space, learned)), training


def _settings(node: Config) -> dict[str, Any]:
    """A group's own settings: without the name it is registered under and the preset it came from."""
    return {key: value for key, value in node.items() if key not in ("name", "preset")}
