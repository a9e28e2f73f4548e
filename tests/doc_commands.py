"""Commands as the pages that say what to type show them."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from pages import ROOT

GUIDES = ("index", "photographs", "refused", "colours", "concepts", "paper", "plug_in", "planar", "scenes", "cluster")
TYPED = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs" / f"{name}.md" for name in GUIDES)]
"""Pages whose commands run; those of others made the figures that they show."""
SHELLS = ("", "bash", "sh")
"""Languages of fenced blocks in which every line is a command."""
SET_BEFORE = r"(?:[A-Z_]+=\S+\s+)*"
INLINE = re.compile(rf"{SET_BEFORE}(?:python|make|ctm|pip|tensorboard)\s+\S")
"""Commands inside a sentence."""
FENCE = re.compile(r"^( *)```(\w*)\n(.*?)^\1```$", re.M | re.S)


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
    for block in FENCE.finditer(text):
        if block[2] in SHELLS:
            first = text[: block.start(3)].count("\n") + 1
            for number, line in _joined(block[3]):
                if words := _words(line):
                    yield Command(page, first + number, words)
    for line, span in spans(page):
        if INLINE.match(span):
            yield Command(page, line, _words(span))


def spans(page: Path) -> Iterator[tuple[int, str]]:
    """The code inside sentences, with its line."""
    text = FENCE.sub(lambda block: "\n" * block[0].count("\n"), page.read_text(encoding="utf-8"))
    for span in re.finditer(r"`([^`]+)`", text):
        yield text[: span.start()].count("\n") + 1, span[1]


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


def _words(text: str) -> tuple[str, ...]:
    lexer = shlex.shlex(text.replace("$CTM_DATA", "data"), posix=True, punctuation_chars="|&;")
    lexer.whitespace_split = True
    words = []
    for word in lexer:
        if set(word) <= set("|&;"):
            break
        words.append(word)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words.pop(0)
    return tuple(word.removesuffix("...") for word in words if word != "...")
