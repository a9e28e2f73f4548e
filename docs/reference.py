"""MkDocs' hook: pages out of what the program reads itself, so that they say the same.

The reference of every config group comes out of the settings' dataclasses and the files in ``conf/``, that of all
scores out of the table of metrics, that of the verbs out of what ``ctm VERB --help`` prints; the notebook becomes a
page.
"""

from __future__ import annotations

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import yaml
from mkdocs.structure.files import File, Files

sys.path.append(str(Path(__file__).resolve().parent / "examples" / "ctm_scenes"))
from ctm_scenes.settings import VERB

from ctm_plugin.compose import choices
from ctm_plugin.compose.command_line import GROUPS, conf_dir
from ctm_plugin.data.settings import FolderConfig
from ctm_plugin.metrics.table import METRICS
from ctm_plugin.settings import commands, listing
from ctm_plugin.settings.registry import REGISTRIES

ROOT = Path(__file__).resolve().parents[1]
VERBS = {**commands.VERBS, "scenes": VERB}
CONF = conf_dir()
NOTEBOOK = "notebooks/start"
OWN_NAMES = ("name", "preset", "kind", "budget")
"""Keys in which a choice says its own name."""
BESIDE: dict[str, Callable[[str], tuple[str, str]]] = {
    "budget": lambda choice: ("backbone", choice.split("_")[0]),
    "ctm_for": lambda choice: ("ctm", "ctm"),
}
"""Groups that Hydra chooses by itself, and whose keys a choice of theirs sets."""
BARE = ("color_space", "experiment")
"""Groups whose choices have no keys of their own."""
AS_WRITTEN = ("experiment", "hydra/sweeper")
"""Groups whose files say more as they are than key by key."""
TOLD = {
    "dataset": "What is photographed.",
    "backbone": "What is trained. The values are the paper's; budgets shrink sizes and steps. `${by_geometry:A,B}`: "
    "A on bounded, B on forward-facing scenes.",
    "ctm": "The learned colour space.",
    "color_space": "A fixed colour space, alone or under the learned one; or [your own](../plug_in.md#a-colour-space).",
    "appearance": "What tells photographs of one scene apart; or [your own](../plug_in.md#the-rest).",
    "loss": "The distance between colours.",
    "trainer": "The budget, the device, the rhythm of curves and checkpoints.",
    "logger": "Where curves, pictures and scores go.",
    "callbacks": "What goes along with a training, by name.",
    "experiment": "Sets of choices with a name: the paper's presets and its tables.",
    "budget": "A backbone's sizes at a trainer's budget: `backbone=dvgo trainer=quick` takes `dvgo_quick`.",
    "ctm_for": "What CTM needs under a backbone: `backbone=barf2d ctm=on` takes `barf2d_on`.",
    "hydra/sweeper": "How a sweep (`-m`) makes runs out of choices.",
}

MORE: dict[str, Callable[[type], object]] = {
    "dataset": lambda settings: getattr(settings, "capture", settings.load),
    "backbone": lambda backbone: backbone.Config,
    "logger": lambda logger: logger,
}
"""By group, whose docstring says more of a choice than a line."""
RUN_FOLDER = {
    "config.yaml": "the version and the resolved configuration; what was fitted to the scene's colours, as a comment",
    "metrics.json": "scores, times, memory, what was run",
    "data.json": "where the data lie, and fingerprints of their parts",
    "cameras.json": "cameras, bounds, masks and light, for `render` and `export` where the data are gone",
    "checkpoints/last.ckpt": "weights, optimizers, configuration; `previous.ckpt` is the checkpoint before it",
    "tensorboard/": "curves, pictures and settings; other loggers have folders of their own",
    "lit/, photo/": "each test view and its photograph, lit alike where the scene is dark",
    "dark/, depth/, latent/": "the same views as dark as the photographs, their distances, and what the field renders",
    "evaluation/": "the same, made again by `ctm evaluate`",
    "video/, export/": "what `ctm render` and `ctm export` wrote",
}
"""What a run writes."""


class Key(NamedTuple):
    """A key of a YAML file: its dotted name, its value as written, the comment beside it."""

    name: str
    value: str
    comment: str


def keys(text: str) -> list[Key]:
    """The keys of a YAML file that have values, but for Hydra's ``defaults`` and the choice's own name.

    What a mapping's comment says stands before the comments of its keys.
    """
    return [key for key in _keys(yaml.compose(text), text.splitlines()) if key.name not in OWN_NAMES]


def _keys(node: yaml.MappingNode, lines: list[str], prefix: str = "", heading: str = "") -> Iterator[Key]:
    for key, value in node.value:
        name = f"{prefix}{key.value}"
        if name == "defaults":
            continue
        mark = key.end_mark if isinstance(value, yaml.MappingNode) else value.end_mark
        comment = ": ".join(part for part in (heading, _comment(lines, mark)) if part)
        if isinstance(value, yaml.MappingNode):
            yield from _keys(value, lines, f"{name}.", comment)
        else:
            yield Key(name, lines[mark.line][value.start_mark.column : mark.column], comment)


def _comment(lines: list[str], mark: yaml.Mark) -> str:
    """What stands behind ``#`` after a mark, and right below it in the same column."""
    column = lines[mark.line].find("#", mark.column)
    parts = []
    for line in lines[mark.line :] if column > 0 else ():
        if line[column : column + 1] != "#" or (parts and line[:column].strip()):
            break
        parts.append(line[column + 1 :].strip())
    return " ".join(parts)


def documented(group: str, choice: str) -> list[Key]:
    """The keys of a choice: of a file that starts from another one, what it says itself; else all."""
    of, name = BESIDE[group](choice) if group in BESIDE else (group, registered(group, choice))
    meanings, own = choices.key_meanings(of, name), keys(read(group, choice))
    if not (group in BESIDE or base(group, choice) or group in BARE):
        values = dict(listing.keys(choices.node(of, name))) | {key.name: key.value for key in own}
        return [Key(key, value, meanings[key]) for key, value in values.items() if key not in OWN_NAMES]
    return [key._replace(comment=key.comment or meanings.get(key.name, "")) for key in own]


def registered(group: str, choice: str) -> str:
    """The name in the registry behind a choice."""
    if group == "callbacks":
        return ""
    if group == "ctm":
        return "none" if choice == "off" else choice if choice in REGISTRIES["ctm"].ours else "ctm"
    return choice


def base(group: str, choice: str) -> str | None:
    """The choice that a choice starts from, where it does."""
    defaults = (yaml.safe_load(read(group, choice)) or {}).get("defaults", [])
    return next((entry.partition("@")[0] for entry in defaults if isinstance(entry, str) and entry != "_self_"), None)


def read(group: str, choice: str) -> str:
    """The file of a choice; for one without, its class's docstring as a comment."""
    path = CONF / group / f"{choice}.yaml"
    if path.is_file():
        return path.read_text(encoding="utf-8")
    about = REGISTRIES[group].about(choice).split("\n\n")[0].replace("\n", " ")
    return f"# {about}\n{{}}"


def introduction(text: str) -> str:
    """The comment at the head of a YAML file."""
    head = []
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        if not line.startswith("# @package"):
            head.append(line[1:].strip())
    return " ".join(head)


def package(text: str) -> str:
    """The part of a configuration whose keys a YAML file sets; "": it names the parts."""
    return text.splitlines()[0].removeprefix("# @package ").replace("_global_", "")


def table(found: list[Key], group: str = "") -> str:
    """Keys as a Markdown table, named as on the command line."""
    prefix = f"{group}." if group else ""
    rows = [f"| `{prefix}{key.name}` | `{key.value}` | {escaped(key.comment)} |" for key in found]
    return "\n".join(["| key | value | |", "|---|---|---|", *rows])


def escaped(text: str) -> str:
    """Plain text for Markdown, but for `code`."""
    parts = text.split("`")
    parts[::2] = [re.sub(r"([\\|*_\[\]])", r"\\\1", part).replace("<", "&lt;") for part in parts[::2]]
    return "`".join(parts)


def more(docstring: str | None) -> str:
    """A docstring as Markdown, without its first paragraph and its sections of arguments and errors."""
    return escaped(listing.plain(inspect.cleandoc(docstring or ""), "`").partition("\n\n")[2])


def group_section(group: str, level: int = 1) -> str:
    """A group's choices, each with its comment and its keys."""
    parts = [f"{'#' * level} {group}", TOLD[group]]
    if group == "dataset":
        parts.append(more(FolderConfig.__doc__))
    if level == 1:
        parts.append(f"On the command line: `{group}=CHOICE`" + ("." if group in BARE else f", `{group}.KEY=VALUE`."))
    for choice in listing.choices(CONF, group):
        text = read(group, choice)
        parts += [f"{'#' * (level + 1)} {choice}", escaped(introduction(text))]
        if group in MORE and choice in REGISTRIES[group].ours:
            parts.append(more(MORE[group](REGISTRIES[group].get(choice)).__doc__))
        if group in AS_WRITTEN:
            body = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
            parts.append(f"```yaml\n{body}\n```" if body else "")
        elif found := documented(group, choice):
            start = base(group, choice)
            parts.append(f"As [`{start}`](#{start}), but for:" if start else "")
            parts.append(table(found, package(text) if group in BESIDE else group))
    return "\n\n".join(part for part in parts if part) + "\n"


def rest() -> str:
    """The keys beside the groups, and the groups that nobody has to choose."""
    head = "# The rest\n\nKeys of a run beside its groups.\n\n"
    metrics = [
        Key(f"metrics.{name}", value, choices.key_meanings("metrics")[name])
        for name, value in listing.keys(choices.node("metrics"))
    ]
    whole = table([*keys((CONF / "config.yaml").read_text(encoding="utf-8")), *metrics])
    beside = "\n".join(group_section(group, level=2) for group in (*BESIDE, "hydra/sweeper"))
    return f"{head}{whole}\n\n{beside}"


def scores() -> str:
    """The numbers of ``metrics.json`` that are scores or costs."""
    head = "# Scores\n\nWhat `metrics.json` of a run says of it; ↑ more is better, ↓ less.\n"
    rows = []
    for name, metric in METRICS.items():
        of = ", ".join(metric.of) or "all"
        cells = [f"`{name}`", metric.label, metric.unit, metric.arrow, of, escaped(metric.about)]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join([head, "| key | name | unit | | scenes with | |", "|---|---|---|---|---|---|", *rows]) + "\n"


def verbs() -> str:
    """What ``ctm VERB --help`` prints of every verb, and what a run leaves."""
    parts = ["# Verbs", "`ctm VERB --help` prints the same.", f"```text\n{commands.USAGE.strip()}\n```"]
    for name, verb in VERBS.items():
        parts.append(f"## {name}")
        if not verb.entry:
            parts += [f"{verb.summary.capitalize()}. Its choices and keys have pages of their own.", run_folder()]
            continue
        about, rows = commands.explained(verb, "`")
        first = about.partition("\n\n")[0]
        parts += [f"```text\n{commands.form(name, verb)}\n```", escaped(first), more(about)]
        if rows:
            shown = [
                (key, value if value in ("", "needed") else f"`{value}`", escaped(words)) for key, value, words in rows
            ]
            cells = [f"| `{key}` | {value} | {words} |" for key, value, words in shown]
            parts.append("\n".join(["| key | default | |", "|---|---|---|", *cells]))
        if verb.others == commands.TRAINING:
            parts.append("A run's choices and keys are taken too.")
    return "\n\n".join(filter(None, parts)) + "\n"


def run_folder() -> str:
    """What a run writes, as Markdown."""
    rows = [f"| `{names}` | {words} |".replace(", ", "`, `", names.count(",")) for names, words in RUN_FOLDER.items()]
    head = "A run writes into `runs/SCENE_BACKBONE_CTM`, with a number where that is taken, or into `hydra.run.dir`:"
    return "\n".join([f"{head}\n", "| file | |", "|---|---|", *rows])


def notebook_page(path: Path) -> str:
    """A notebook without outputs as Markdown."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(f"```python\n{source}\n```" if cell["cell_type"] == "code" else source)
    return "\n\n".join(parts) + f"\n\n[Download this notebook]({path.name}).\n"


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to the notebook lead to its page."""
    return markdown.replace(f"({NOTEBOOK}.ipynb)", f"({NOTEBOOK}.md)")


def on_files(files: Files, config) -> Files:
    """Add the pages that are made."""
    for group in GROUPS:
        files.append(File.generated(config, f"reference/{group}.md", content=group_section(group)))
    files.append(File.generated(config, "reference/rest.md", content=rest()))
    files.append(File.generated(config, "reference/scores.md", content=scores()))
    files.append(File.generated(config, "reference/verbs.md", content=verbs()))
    page = notebook_page(ROOT / "docs" / f"{NOTEBOOK}.ipynb")
    files.append(File.generated(config, f"{NOTEBOOK}.md", content=page))
    return files
