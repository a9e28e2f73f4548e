"""What is handed out: one version everywhere, files that an index takes, a wheel made of the sdist alone."""

import re
import tomllib
import zipfile
from email.parser import BytesParser
from pathlib import Path

import pytest
import yaml
from packaging.metadata import Metadata

import ctm_plugin
from ctm_plugin.cli import main

ROOT = Path(__file__).parents[1]
SEMANTIC = r"(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)(-[0-9A-Za-z.-]+)?(\+[0-9A-Za-z.-]+)?"


@pytest.fixture
def packed(wheel) -> zipfile.ZipFile:
    return zipfile.ZipFile(wheel)


def test_one_version_which_is_semantic():
    version = ctm_plugin.__version__
    assert re.fullmatch(SEMANTIC, version)
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == version
    headings = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    versions = [heading for heading in headings if heading != "Unreleased"]
    assert versions[0] == version
    assert versions == sorted(versions, key=lambda each: [*map(int, each.split("."))], reverse=True)


def test_changes_are_a_line_each():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1000
    kinds = ("- ", "## ", "# ")
    loose = [line for line in text.partition("\n## ")[2].splitlines()[1:] if line and not line.startswith(kinds)]
    assert all(re.fullmatch(r"\d{1,2} [A-Z][a-z]+ \d{4}", line) for line in loose)


def test_the_extras_are_in_the_readme():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    extras = re.search(r"^Extras.*?\n\n", readme, re.MULTILINE | re.DOTALL)
    assert set(project["optional-dependencies"]) == set(re.findall(r"`(\w+)`", extras[0]))


def test_metadata_is_what_an_index_takes(sdist, packed):
    """The rules of the core metadata's specification; the README is told as what it is."""
    name = f"ctm_plugin-{ctm_plugin.__version__}.dist-info/METADATA"
    for content in ((sdist / "PKG-INFO").read_bytes(), packed.read(name)):
        found = Metadata.from_email(content, validate=True)
        assert (found.name, str(found.version)) == ("ctm-plugin", ctm_plugin.__version__)
        assert found.description_content_type == "text/markdown"
        assert found.license_expression == "MIT"
        assert BytesParser().parsebytes(content).get_payload().startswith("# ctm_plugin")


def test_the_sdist_is_enough_for_the_wheel(sdist, packed):
    files = {path.relative_to(sdist).as_posix() for path in sdist.rglob("*") if path.is_file()}
    beside = {"README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md", "CONTRIBUTING.md", "Makefile"}
    assert beside <= files
    ours = [path for path in files if path.startswith(("ctm_plugin/", "hydra_plugins/"))]
    ours += [f"ctm_plugin/{path}" for path in files if path.startswith("conf/")]
    names = {name for name in packed.namelist() if ".dist-info/" not in name}
    assert names == set(ours)
    for folder in ("ctm_plugin", "hydra_plugins"):
        for path in (ROOT / folder).rglob("*.py"):
            assert path.relative_to(ROOT).as_posix() in names


def test_the_command_of_the_wheel(packed):
    entries = packed.read(f"ctm_plugin-{ctm_plugin.__version__}.dist-info/entry_points.txt").decode()
    assert entries.split() == ["[console_scripts]", "ctm", "=", f"{main.__module__}:{main.__name__}"]
