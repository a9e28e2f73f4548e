"""The reference of the config groups, out of dataclasses and ``conf/``: nothing is left out, nothing without a word."""

import re
from types import ModuleType

import pytest
from omegaconf import DictConfig, OmegaConf
from pages import load

from ctm_plugin.compose.choices import node
from ctm_plugin.compose.command_line import GROUPS, conf_dir
from ctm_plugin.settings.commands import explained
from ctm_plugin.settings.listing import choices

pytestmark = pytest.mark.slow

KEYED = (*(group for group in GROUPS if group != "experiment"), "budget", "ctm_for")
CHOICES = [(group, choice) for group in KEYED for choice in choices(conf_dir(), group)]


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    return load("docs/reference.py")


def flat(node: DictConfig, prefix: str = "") -> dict[str, object]:
    """Values by dotted name, as OmegaConf reads a file."""
    found = {}
    for name in node:
        value = node._get_node(name)
        if isinstance(value, DictConfig):
            found |= flat(value, f"{prefix}{name}.")
        elif name != "defaults":
            found[f"{prefix}{name}"] = value
    return found


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_key_is_there_with_its_value_and_a_comment(reference, group, choice):
    found = reference.documented(group, choice)
    path = conf_dir() / group / f"{choice}.yaml"
    expected = {}
    if choice == "none":
        pass
    elif group in ("dataset", "backbone", "appearance", "logger", "callbacks") or f"{group}/{choice}" in (
        "ctm/auto",
        "ctm/on",
        "trainer/paper",
        "loss/auto",
        "loss/l1",
        "loss/mse",
    ):
        expected = flat(OmegaConf.create(node(group, {"on": "ctm", "default": ""}.get(choice, choice))))
    if path.is_file() and isinstance(file := OmegaConf.load(path), DictConfig):
        expected |= flat(file)
    own = [name for name in expected if name not in reference.OWN_NAMES]
    assert [key.name for key in found] == own
    for key in found:
        assert OmegaConf.create(f"x: {key.value}")._get_node("x") == expected[key.name]
        assert key.comment, f"conf/{group}/{choice}.yaml: {key.name} has no comment"
    section = reference.group_section(group)
    assert f"## {choice}\n" in section
    part = path.read_text(encoding="utf-8").split()[2] if group in reference.BESIDE else group
    prefix = "" if part == "_global_" else f"{part}."
    assert all(f"| `{prefix}{key.name}` | `{key.value}` |" in section for key in found)


def test_the_keys_beside_the_groups(reference):
    names = [key.name for key in reference.keys((conf_dir() / "config.yaml").read_text())]
    assert {"seed", "resume", "sweep.resume", "hydra.sweep.dir"} <= set(names)
    page = reference.rest()
    assert all(f"`{name}`" in page for name in (*names, "metrics.lpips_weights"))
    assert "## budget" in page
    beside = ("backbone.steps", "backbone.relative", "backbone.shifts_until", "ctm.photometric", "ctm.fills")
    assert all(f"| `{name}` |" in page for name in beside)
    assert "`ctm.relative`" not in page


def test_the_page_of_verbs(reference):
    """Each verb, what its help says of it, and its settings with their defaults."""
    page = reference.verbs()
    for (name, verb), part in zip(reference.VERBS.items(), page.split("\n## ")[1:], strict=True):
        assert part.startswith(f"{name}\n")
        if verb.entry:
            about, rows = explained(verb)
            assert f"ctm {name} {verb.words}".strip() in part
            assert all(f"| `{key}` | " in part for key, *_ in rows)
            assert set(re.findall(r"[a-z]{4,}", about)) <= set(re.findall(r"[a-z]{4,}", part))
            assert part.count("\n| `") == len(rows)
    assert "| `frames` | `120` | " in page
    assert "| `out` | needed | " in page
    assert "| `lit/`, `photo/` | each test view" in page
    assert "- `mesh`: marching cubes" in page
    assert "Raises:" not in page


def test_a_docstring_as_markdown(reference):
    found = reference.more("""A line.

    More of ``it_self``, by :func:`~ctm_plugin.data.load.to_ndc_frame` and so_on.

    Raises:
        Never.
    """)
    assert found == "More of `it_self`, by `to_ndc_frame` and so\\_on."
    assert reference.more("A line.") == reference.more(None) == ""
    page = reference.group_section("dataset")
    assert "PNG, JPEG, WebP" in page
    assert "are read as by `dataset=transforms`" in page


def test_comments_of_a_file(reference):
    text = (
        "# What it is.\n"
        "# More of it.\n"
        "defaults:\n  - base\n"
        "plain: 1            # one <two> | `a|b`\n"
        "long: [1, 2]        # first line,\n"
        "                    # second line\n"
        "mapping:            # all of\n"
        "  inner: '#'        # these\n"
        "  other: 2\n"
        "bare: 3\n"
    )
    assert reference.keys(text) == [
        ("plain", "1", "one <two> | `a|b`"),
        ("long", "[1, 2]", "first line, second line"),
        ("mapping.inner", "'#'", "all of: these"),
        ("mapping.other", "2", "all of"),
        ("bare", "3", ""),
    ]
    assert reference.introduction(text) == "What it is. More of it."
    assert reference.escaped("|a| <b> `c|d`") == r"\|a\| &lt;b> `c|d`"


def test_presets_stand_as_they_are_written(reference):
    page = reference.group_section("experiment")
    for path in (conf_dir() / "experiment").glob("*.yaml"):
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        assert "\n".join(lines) in page
