"""Backbones, data sets, colour spaces, appearances, metrics, loggers and callbacks by name, ours and those of others.

Another package registers its own through an entry point, in its ``pyproject.toml``::

    [project.entry-points."ctm_plugin.backbones"]
    tiny = "my_package.tiny:Tiny"

What is registered must be:

- a data set: a dataclass, its settings, with a method ``load() -> Scene``;
- a backbone: a :class:`ctm_plugin.backbones.base.Backbone` with a dataclass ``Config``, its settings, called with
  ``(config, scene, transform, photometric, seed)``;
- a colour space: a :class:`ctm_plugin.color.transform.ColorTransform` without parameters, called with ``(config)``,
  its dataclass ``Config``; one of ours is a file in ``color/spaces/``, which imports its ``Config``;
- a colour transform, a learned space: the same with parameters;
- an appearance: an :class:`ctm_plugin.appearance.exposure.Exposure`, called with ``(config, views)``, its dataclass
  ``Config`` and the training views;
- a metric: a :class:`ctm_plugin.metrics.table.Metric`;
- a logger: a :class:`ctm_plugin.loggers.base.RunLogger` with a dataclass ``Config``, called with
  ``(config, run, step)``;
- a callback: a dataclass, its settings, that is a Lightning ``Callback``;
- a verb: a :class:`ctm_plugin.settings.commands.Verb`.
"""

from __future__ import annotations

import ast
import functools
import importlib.metadata
import inspect
import sys
from importlib import import_module
from importlib.metadata import EntryPoints
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ctm_plugin.errors import CTMError, UnknownNameError

PACKAGE = Path(__file__).parents[1]


def conf_dir() -> Path:
    """Find ``conf/`` inside the package, where a wheel puts it, or next to it, in a checkout."""
    package = PACKAGE.resolve()
    inside, beside = package / "conf", package.parent / "conf"
    return inside if inside.is_dir() else beside


def entry_points(group: str) -> EntryPoints:
    """Find the entry points of installed packages; metadata are read again where a folder of theirs has changed."""
    folders = [path for folder in sys.path if (path := Path(folder).absolute()).exists()]
    return _entry_points(group, tuple((path, path.stat().st_mtime_ns) for path in folders))


@functools.lru_cache(maxsize=16)
def _entry_points(group: str, folders: tuple[tuple[Path, int], ...]) -> EntryPoints:
    return importlib.metadata.entry_points(group=group)


class Registry:
    """Names of one kind of thing, imported when asked for.

    Args:
        kind: what they are, for messages.
        group: the entry-point group.
        ours: ``name -> "module:attribute"``.
    """

    def __init__(self, kind: str, group: str, ours: dict[str, str]):
        self.kind = kind
        self.group = group
        self.ours = ours
        self.added: dict[str, Any] = {}

    def others(self) -> dict[str, Any]:  # where a package (MLflow) imports importlib_metadata, its EntryPoint
        """Find the entry points of other installed packages, without those that have a built-in name."""
        return {entry.name: entry for entry in entry_points(group=self.group) if entry.name not in self.ours}

    def names(self) -> list[str]:
        return sorted({*self.ours, *self.added, *self.others()})

    def settings(self, name: str) -> type:
        """Find the settings' dataclass of a registered name; of a built-in name the dataclass's module is imported.

        Raises:
            CTMError: see :meth:`get`.
        """
        if name in self.ours and name not in self.added:
            return load(config_of(self.ours[name]))
        thing = self.get(name)
        return getattr(thing, "Config", thing)

    def about(self, name: str) -> str:
        """Read the docstring of a built-in class, without importing it; of other classes name the package."""
        if name in self.ours:
            own, module = self.ours[name], self.ours[name].partition(":")[0]
            settings = config_of(own).removeprefix(NOTHING)
            return said_by(own) or (settings and said_by(settings)) or said_by(module)
        if name in self.added:
            return "from this program"
        entry = self.others()[name]
        return f"from {entry.dist.name}" if entry.dist else "from another package"

    def docstring(self, name: str) -> str:
        """Read the whole docstring of a registered class; another package's class is imported for it."""
        if name in self.ours:
            return self.about(name)
        thing = self.get(name)
        text = inspect.cleandoc(thing.__doc__ or "")
        return "" if text.startswith(f"{thing.__name__}(") else text  # a dataclass's own, its signature

    def register(self, name: str, thing: Any) -> None:
        """Register a class under a name from a running program, without an entry point.

        Raises:
            CTMError: if the name is taken.
        """
        if name in self.names():
            raise CTMError(f"{self.kind} {name!r} is registered already")
        self.added[name] = thing

    def get(self, name: str) -> Any:
        """Import what is registered under a name.

        Raises:
            UnknownNameError: nothing is registered under the name; the message lists the known names.
            CTMError: another package's entry point cannot be imported.
        """
        if name in self.added:
            return self.added[name]
        if name in self.ours:
            return load(self.ours[name])
        entry = self.others().get(name)
        if entry is None:
            raise UnknownNameError(self.kind, name, self.names())
        try:
            return entry.load()
        except Exception as error:
            raise CTMError(f"{self.kind} {name!r} ({entry.value}) cannot be imported: {error!r}") from error


BACKBONES = Registry(
    "backbone",
    "ctm_plugin.backbones",
    {
        "barf2d": "ctm_plugin.backbones.barf2d:BARF2D",
        "dvgo": "ctm_plugin.backbones.dvgo:DVGO",
        "nerf": "ctm_plugin.backbones.nerf:NeRF",
        "ngp": "ctm_plugin.backbones.ngp:NGP",
        "splat": "ctm_plugin.backbones.splat:Splat",
    },
)
DATASETS = Registry(
    "dataset",
    "ctm_plugin.datasets",
    {
        "blender": "ctm_plugin.data.blender:BlenderConfig",
        "colmap": "ctm_plugin.data.colmap:ColmapConfig",
        "llff": "ctm_plugin.data.llff:LLFFConfig",
        "planar": "ctm_plugin.data.planar:PlanarConfig",
        "rawnerf": "ctm_plugin.data.rawnerf:RawNeRFConfig",
        "still_life": "ctm_plugin.data.embedded:StillLifeConfig",
        "transforms": "ctm_plugin.data.transforms:TransformsConfig",
        "white_room": "ctm_plugin.data.embedded:WhiteRoomConfig",
    },
)
TRANSFORMS = Registry(
    "colour transform",
    "ctm_plugin.color_transforms",
    {"auto": "ctm_plugin.color.auto:Auto", "ctm": "ctm_plugin.color.ctm:CTM"},
)
COLOR_SPACES = Registry(
    "color_space",
    "ctm_plugin.color_spaces",
    {path.stem: f"ctm_plugin.color.spaces.{path.stem}:Space" for path in PACKAGE.glob("color/spaces/[a-z]*.py")},
)
APPEARANCES = Registry("appearance", "ctm_plugin.appearances", {"exposure": "ctm_plugin.appearance.exposure:Exposure"})
METRICS_OF_OTHERS = Registry("metric", "ctm_plugin.metrics", {})
LOGGERS = Registry(
    "logger",
    "ctm_plugin.loggers",
    {name.lower(): f"ctm_plugin.loggers.services:{name}" for name in ("TensorBoard", "WandB")},
)
CALLBACKS = Registry(
    "callback",
    "ctm_plugin.callbacks",
    {"progress": "ctm_plugin.callbacks.progress:ProgressLine", "dashboard": "ctm_plugin.callbacks.dashboard:Dashboard"},
)
REGISTRIES = {
    "dataset": DATASETS,
    "backbone": BACKBONES,
    "ctm": TRANSFORMS,
    "color_space": COLOR_SPACES,
    "appearance": APPEARANCES,
    "logger": LOGGERS,
    "callbacks": CALLBACKS,
}
"""Registries by config group."""
PRESET_SETTINGS = {
    "loss": "ctm_plugin.color.settings:LossConfig",
    "trainer": "ctm_plugin.runs.settings:TrainerConfig",
    "metrics": "ctm_plugin.metrics.settings:MetricsConfig",
}
"""Dataclasses of the groups whose choices differ only in values."""
NOTHING = "ctm_plugin.settings.setting:Nothing"
"""Dataclass for choices without settings."""
CTM_SETTINGS = "ctm_plugin.color.settings:TransformTraining"
"""Dataclass of the settings that all choices of ``ctm`` share."""


def load(entry: str) -> Any:
    """Import the object that ``module:name`` stands for."""
    module, _, name = entry.partition(":")
    return getattr(import_module(module), name)


def said_by(entry: str) -> str:
    """Read the docstring of a ``module:name``, or of a ``module``, without importing it."""
    own, _ = parsed(entry)
    return ast.get_docstring(own) or ""


@functools.cache
def config_of(entry: str) -> str:
    """Find the ``module:dataclass`` of a class's settings, without importing either.

    It is what the class calls its ``Config``, else the class itself where it is a dataclass with fields, else the first
    of its bases that comes from a module ``settings``, which needs no torch.
    """
    own, tree = parsed(entry)
    imports = (each for each in tree.body if isinstance(each, ast.ImportFrom))
    homes = {alias.name: each.module for each in imports for alias in each.names}
    given = (node for node in own.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value)
    names = [ast.unparse(node.value) for node in given if ast.unparse(node).startswith(("Config =", "Config:"))]
    if any(isinstance(node, ast.AnnAssign) for node in own.body) and own.decorator_list:
        names.append(own.name)
    names += [base for base in map(ast.unparse, own.bases) if homes.get(base, "").endswith(".settings")]
    return f"{homes.get(names[0], entry.partition(':')[0])}:{names[0]}" if names else NOTHING


def parsed(entry: str) -> tuple[Any, ast.Module]:
    """Parse what stands for ``module:name``, or ``module``, and its module, without importing it."""
    module, _, name = entry.partition(":")
    tree = ast.parse(Path(find_spec(module).origin).read_text(encoding="utf-8"))
    return next((node for node in tree.body if name and getattr(node, "name", "") == name), tree), tree
