"""The keys of our own classes, read from their source: mistyped ones are refused before torch is imported."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def keys_of(entry: str) -> list[str]:
    """Find the dotted keys of the settings of what stands for ``module:Class`` of this package.

    They are the fields of the class's ``Config``, its own or a base's, or of the class itself where there is none.
    """
    return list(annotations_of(entry))


def annotations_of(entry: str) -> dict[str, str]:
    """Find those keys, and their types as they are written there."""
    found = _find(*entry.split(":"))
    return {} if found is None else dict(_fields(*(_config(*found) or found)))


def settings_of(entry: str) -> list[str]:
    """Find the keys of a verb, ``module:function``: the fields of the class that its parameter ``settings`` is of."""
    module, _, name = entry.partition(":")
    functions = (node for node in _body(module) if isinstance(node, ast.FunctionDef) and node.name == name)
    given = (each for node in functions for each in (*node.args.args, *node.args.kwonlyargs))
    kinds = (each.annotation.id for each in given if each.arg == "settings")
    return [key for kind in kinds for key in keys_of(f"{module}:{kind}")]


Found = tuple[str, ast.ClassDef]
"""A module's name, and a class in it."""


@cache
def _body(module: str) -> list[ast.stmt]:
    """The statements of one of our modules; of others none."""
    package, *parts = module.split(".")
    file, folder = PACKAGE.joinpath(*parts).with_suffix(".py"), PACKAGE.joinpath(*parts, "__init__.py")
    path = next((path for path in (file, folder) if package == PACKAGE.name and path.is_file()), None)
    return [] if path is None else ast.parse(path.read_text(encoding="utf-8")).body


def _find(module: str, name: str) -> Found | None:
    """The class, in the module or in one of ours that it is imported from; ``None``: it is somebody else's."""
    for node in _body(module):
        if isinstance(node, ast.ClassDef) and node.name == name:
            return module, node
        if isinstance(node, ast.ImportFrom) and name in [each.name for each in node.names]:
            return _find(node.module, name)
    return None


def _bases(module: str, node: ast.ClassDef) -> Iterator[Found]:
    found = (_find(module, base.id) for base in node.bases if isinstance(base, ast.Name))
    yield from (each for each in found if each is not None)


def _config(module: str, node: ast.ClassDef) -> Found | None:
    """The class's ``Config``: a class in it, or a name that it has there."""
    for each in node.body:
        if isinstance(each, ast.ClassDef) and each.name == "Config":
            return module, each
        if isinstance(each, ast.Assign | ast.AnnAssign) and ast.unparse(each).startswith(("Config = ", "Config: ")):
            return _find(module, each.value.id)
    return next((config for base in _bases(module, node) if (config := _config(*base))), None)


def _fields(module: str, node: ast.ClassDef) -> Iterator[tuple[str, str]]:
    for base in _bases(module, node):
        yield from _fields(*base)
    for each in node.body:
        if isinstance(each, ast.AnnAssign) and not ast.unparse(each.annotation).startswith("ClassVar"):
            kind = _find(module, each.annotation.id) if isinstance(each.annotation, ast.Name) else None
            name, inner = each.target.id, [] if kind is None else list(_fields(*kind))
            yield from ((f"{name}.{key}", type_) for key, type_ in inner)
            yield from () if inner else [(name, ast.unparse(each.annotation))]
