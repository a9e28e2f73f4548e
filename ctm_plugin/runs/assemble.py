"""From a resolved configuration to the objects of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import lightning as L

from ctm_plugin.appearance.measured_gains import gains_by_points
from ctm_plugin.backbones.base import Backbone
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.color.transform import Chain, ColorTransform
from ctm_plugin.compose.checks import checked, convert, name_of, section_of, transform_of
from ctm_plugin.data.capture import Capture
from ctm_plugin.draws import seeded
from ctm_plugin.errors import ConfigError, CTMError
from ctm_plugin.loggers.base import RunLogger
from ctm_plugin.metrics.settings import MetricsConfig
from ctm_plugin.metrics.table import add_others
from ctm_plugin.runs.settings import TrainerConfig
from ctm_plugin.settings.build import Config
from ctm_plugin.settings.registry import APPEARANCES, BACKBONES, CALLBACKS, COLOR_SPACES, DATASETS, LOGGERS, TRANSFORMS


@dataclass
class Parts:
    """Objects that a run consists of."""

    scene: Any
    backbone: Backbone
    trainer: TrainerConfig
    metrics: MetricsConfig
    loggers: list[RunLogger] = field(default_factory=list)
    callbacks: list[L.Callback] = field(default_factory=list)


def assemble(
    config: Config, run: Path | None = None, step: int = 0, scene: Any = None, capture: Capture | None = None
) -> Parts:
    """Build everything a configuration names, checking all of it before any data is read.

    Args:
        config: the resolved configuration.
        run: the directory of a run that is to be trained, from ``step`` on. Loggers and callbacks are only built for
            it: scoring does not need their packages.
        scene: scene to use in place of the configuration's, whose data are gone.
        capture: the capture of the configuration's data, where it has been read already.

    Raises:
        CTMError: on anything that cannot be used, naming the key or the file.
    """
    given = checked(config, watched=run is not None)
    add_others()
    seed = config["seed"]
    photometric = convert(Photometric, given["loss"])
    transform = color_transform(config, seed)
    name = name_of(config["backbone"])
    backbone = BACKBONES.get(name)
    shares = name_of(config["appearance"])
    if shares != "none" and not backbone.posed:
        raise ConfigError("appearance", shares, f"none: backbone={name} has no pictures that cameras took")
    observers = ([], [])
    if run is not None:
        observed = [convert(CALLBACKS.get(each), settings) for each, settings in given["callbacks"].items()]
        observers = (loggers(config, run, step), observed)
    scene = load_scene(config, capture) if scene is None else scene
    if not isinstance(scene, backbone.Scene):
        expected = f"a data set that backbone={name} can train on (a {backbone.Scene.__name__})"
        if others := " or ".join(f"backbone={each}" for each in _made_for(scene)):
            expected += f"; this one is for {others}"
        raise ConfigError("dataset", name_of(config["dataset"]), expected)
    module = backbone(given["backbone"], scene, transform, photometric, seed)
    trainer: TrainerConfig = given["trainer"]
    if trainer.minutes is not None and module.pace is None:
        raise ConfigError("trainer.minutes", trainer.minutes, f"null: backbone={name} takes all its steps")
    if shares != "none":
        views = replace(scene.train, gains=gains_by_points(scene))
        module.appearance = APPEARANCES.get(shares)(given["appearance"], views)
    return Parts(scene, module, trainer, given["metrics"], *observers)


def _made_for(scene: Any) -> Iterator[str]:
    """Find the names of backbones that train on a scene; other packages' that cannot be imported are skipped."""
    for name in BACKBONES.names():
        with suppress(CTMError):
            if isinstance(scene, BACKBONES.get(name).Scene):
                yield name


def loggers(config: Config, run: Path, step: int) -> list[RunLogger]:
    """Build a run's loggers; ``step`` is the step that the run resumes from.

    Raises:
        CTMError: on settings that cannot be used, or where a logger's package is missing.
    """
    name = name_of(config["logger"])
    settings = section_of(config, "logger")
    if name == "none":
        return []
    try:
        return [LOGGERS.get(name)(settings, run, step)]
    except ModuleNotFoundError as error:
        expected = f"an installed package ({error}): pip install -e '.[{name}]'"
        raise ConfigError("logger", name, expected) from error


def load_scene(config: Config, capture: Capture | None = None) -> Any:
    """Load the data set that a configuration names; its ``capture`` is given where it has been read already."""
    dataset = convert(DATASETS.get(name_of(config["dataset"])), section_of(config, "dataset"))
    return dataset.load() if capture is None else dataset.load(capture)


def color_transform(config: Config, seed: int) -> ColorTransform:
    """Build the fixed colour space with the learned transform on top, and its training settings as ``learning``.

    Raises a ConfigError for a space that learns, or under the learned one has not 3 channels.
    """
    name = name_of(config["color_space"])
    with seeded(seed):
        space = COLOR_SPACES.get(name)(section_of(config, "color_space"))
    space.label = f"color_space={name}"
    if any(True for _ in space.parameters()):
        raise ConfigError("color_space", name, "one without parameters: a space that learns is a ctm")
    node, (space.learning, settings) = config["ctm"], transform_of(config)
    if name_of(node) == "none":
        return space
    with seeded(seed):
        learned = TRANSFORMS.get(name_of(node))(settings)
    learned.label, learned.learning = f"ctm={node.get('preset', name_of(node))}", space.learning
    if name == "rgb":
        return learned
    if space.channels != 3:
        raise ConfigError("color_space", name, f"one of 3 channels under {learned.label}")
    return Chain(space, learned)
