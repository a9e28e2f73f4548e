"""The examples in docstrings, run; and what docstrings have to say."""

import ast
import doctest
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import ctm_plugin
from ctm_plugin.compose.command_line import conf_dir

pytestmark = pytest.mark.slow

ROOT = Path(ctm_plugin.__file__).parent
NAMES = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py"))
SHOWING = sorted(path for path in ROOT.rglob("*.py") if ">>>" in path.read_text())


def test_there_are_some():
    assert len(SHOWING) >= 6


@pytest.mark.parametrize("path", SHOWING, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_examples(path):
    name = ".".join(("ctm_plugin", *path.relative_to(ROOT).with_suffix("").parts))
    result = doctest.testmod(importlib.import_module(name), extraglobs={"torch": torch})
    assert result.attempted
    assert not result.failed


def functions(tree: ast.Module) -> Iterator[tuple[ast.ClassDef | None, ast.FunctionDef]]:
    """Public functions, and methods with the class that they are of."""
    for node in tree.body:
        for each in node.body if isinstance(node, ast.ClassDef) else [node]:
            if isinstance(each, ast.FunctionDef) and not each.name.startswith("_"):
                yield node if isinstance(node, ast.ClassDef) else None, each


def shapeless(function: ast.FunctionDef) -> bool:
    """Whether it takes or gives tensors or arrays, and says neither a shape nor whose shapes they are."""
    arguments = [*function.args.args, *function.args.kwonlyargs]
    given = [*(each.annotation for each in arguments if each.annotation), *filter(None, [function.returns])]
    plain = re.sub(r"\b\w+\[(Tensor|np\.ndarray), ", "", "; ".join(map(ast.unparse, given)))
    told = ast.get_docstring(function) or ""
    return bool(re.search(r"\b(Tensor|ndarray)\b", plain)) and not re.search(r"\[|:(func|meth):", told)


@pytest.mark.parametrize("name", NAMES)
def test_functions_of_tensors_say_their_shapes(name):
    # A method without words is another class's, which has them.
    found = [
        function.name
        for owner, function in functions(ast.parse((ROOT / name).read_text()))
        if shapeless(function) and not (owner and owner.bases and not ast.get_docstring(function))
    ]
    assert not found


FOREIGN = re.compile(
    r"\b(alone|told)\b(?!:)|\bbeside\b|unless said otherwise|before black|\b[Ll]ifted\b|befall|of somebody|as it is now"
)
"""Say only, shown, next to, by default, on a black background, brightened; parameters of such names may stay."""
MOST_WORDS = 25


@pytest.mark.parametrize("name", NAMES)
def test_docstrings_messages_and_meanings_are_plain(name):
    tree = ast.parse((ROOT / name).read_text())
    strings = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    assert not [text for text in strings if " " in text and FOREIGN.search(text)]
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    settings = [call.args for call in calls if ast.unparse(call.func) in ("setting", "by_geometry")]
    meanings = [each.value for given in settings for each in given[1:3] if isinstance(each, ast.Constant)]
    assert not [text for text in meanings if isinstance(text, str) and len(re.findall(r"\S*\w\S*", text)) > MOST_WORDS]


@pytest.mark.parametrize("name", NAMES)
def test_docstrings_begin_with_what_a_thing_is(name):
    """None begins with "Of ", those of constants and fields included."""
    bare = (node.value for node in ast.walk(ast.parse((ROOT / name).read_text())) if isinstance(node, ast.Expr))
    assert not [
        ast.unparse(each) for each in bare if isinstance(each, ast.Constant) and str(each.value).startswith("Of ")
    ]


@pytest.mark.parametrize("path", sorted(conf_dir().rglob("*.yaml")), ids=lambda path: f"{path.parent.name}/{path.name}")
def test_comments_of_choices_are_plain(path):
    assert not [line for line in path.read_text().splitlines() if FOREIGN.search(line.partition("#")[2])]
