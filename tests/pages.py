"""The pages that are written by hand, and what of them is prose."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from unittest.mock import patch

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GENERATED = re.compile(r"^<!-- table: [a-z0-9_]+ -->$.*?^<!-- end -->$", re.M | re.S)
FENCE = re.compile(r"^( *)(```|~~~).*?^\1\2\s*$", re.M | re.S)
LINK = re.compile(
    r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]*(?:\([^()]*\))?[^()\s]*)(?:\s+\"[^\"]*\")?\)(?:\{[^}]*\})?"
)
"""A link or a picture: what is shown, where it leads."""
SPAN = re.compile(r"(`+)(?!`).+?(?<!`)\1(?!`)", re.S)
MATH = re.compile(r"\$\$.+?\$\$|(?<![\\\w$])\$(?=\S)[^$\n]+?(?<=\S)\$(?![\w$])", re.S)
TAG = re.compile(r"<!--.*?-->|</?[A-Za-z][^<>]*>", re.S)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def load(path: str) -> ModuleType:
    """A script of the checkout as a module, which finds its neighbours."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)  # where dataclasses look for it
    with patch.object(sys, "path", [str((ROOT / path).parent), *sys.path]):
        spec.loader.exec_module(module)
    return module


def by_hand(text: str) -> str:
    """A page without its generated tables."""
    return GENERATED.sub("", text)


def prose(text: str, code: str = "") -> str:
    """What is written for a reader: no generated tables, blocks, tags, links' targets; ``code`` for code and math."""
    text = TAG.sub(" ", FENCE.sub("", by_hand(text)))
    return LINK.sub(lambda link: link[2], MATH.sub(code, SPAN.sub(code, text)))
