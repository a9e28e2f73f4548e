"""Commands as the README and the pages of ``docs/`` show them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
SHELLS = ("", "bash", "sh")
"""Languages of fenced blocks in which every line is a command."""
SET_BEFORE = r"(?:[A-Z_]+=\S+\s+|time\s+)*"
INLINE = re.compile(rf"{SET_BEFORE}(?:python|make|ctm|pip|tensorboard)\s+\S")
"""Commands inside a sentence."""
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.M | re.S)
STANDS_FOR = re.compile(r"`([A-Z]+)` stands for\s+`([^`]+)`")


class Command(NamedTuple):
    """A command of a page.

    Attributes:
        page, line: where it is.
        words: as a shell would give them to a program, without variables set before and what follows on its failure.
    """

    page: Path
    line: int
    words: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def commands(page: Path) -> Iterator[Command]:
    """All commands of a page, in its order: those in fenced blocks, then those inside sentences."""
    text = page.read_text(encoding="utf-8")
    names = {"CTM_DATA": "data", "RUN": "RUN_DIR"}
    shorthands = dict(STANDS_FOR.findall(text))
    for block in FENCE.finditer(text):
        if block[2] in SHELLS:
            first = text[: block.start(3)].count("\n") + 1
            yield from _block(page, first, block[3], names, shorthands)
    for line, span in spans(page):
        if INLINE.match(span):
            yield Command(page, line, _words(span, names, shorthands))


def spans(page: Path) -> Iterator[tuple[int, str]]:
    """The code inside sentences, with its line."""
    text = FENCE.sub(lambda block: "\n" * block[0].count("\n"), page.read_text(encoding="utf-8"))
    for span in re.finditer(r"`([^`]+)`", text):
        yield text[: span.start()].count("\n") + 1, span[1]


def _block(page: Path, first: int, block: str, names: dict[str, str], shorthands: dict[str, str]) -> Iterator[Command]:
    before = ""
    for number, line in _joined(block):
        if assigned := re.fullmatch(r'(\w+)="([^"]*)"', line.strip()):
            names[assigned[1]] = assigned[2]
            continue
        if line.startswith("... "):  # the command above with more at its end
            line = before + line.removeprefix("...")
        else:
            before = line.partition("  #")[0]
        if line.strip():
            yield Command(page, first + number, _words(line, names, shorthands))


def _joined(block: str) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, those that end in a backslash with the next one."""
    whole, start = "", 0
    for number, line in enumerate(block.splitlines()):
        start = start if whole else number
        whole += line
        if whole.endswith("\\"):
            whole = whole[:-1]
            continue
        yield start, whole
        whole = ""


def _words(text: str, names: dict[str, str], shorthands: dict[str, str]) -> tuple[str, ...]:
    for name, value in shorthands.items():
        text = re.sub(rf"(?<=\s){name}(?=\s)", lambda _, value=value: value, text)
    for _ in range(2):  # a variable may hold another
        text = re.sub(r"\$(\w+)", lambda name: names.get(name[1], name[0]), text)
    text = re.sub(r"\[(--[^\]]+)\]", r"\1", text)  # what may be left out
    lexer = shlex.shlex(text, posix=True, punctuation_chars="|&;")
    lexer.whitespace_split = True
    words = []
    for word in lexer:
        if set(word) <= set("|&;"):
            break
        words.append(word)
    while re.fullmatch(r"[A-Z_]+=.*|time", words[0]):
        words.pop(0)
    return tuple(word.removesuffix("...") for word in words if word != "...")
