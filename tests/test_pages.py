"""Pages that a person can read: short, of short sentences in plain words, with links that lead somewhere."""

import re

import pytest
from pages import FENCE, LINK, PAGES, ROOT, SPAN, by_hand, name_of, prose

from ctm_plugin.compose.command_line import GROUPS

BUDGETS = {
    "README.md": 590,
    "docs/index.md": 300,
    "docs/photographs.md": 810,
    "docs/refused.md": 610,
    "docs/colours.md": 570,
    "docs/concepts.md": 460,
    "docs/paper.md": 870,
    "docs/plug_in.md": 1030,
    "docs/results.md": 1070,
    "docs/planar.md": 500,
    "docs/method.md": 2230,
    "docs/architecture.md": 970,
    "docs/reliability.md": 690,
    "docs/cluster.md": 260,
    "docs/scenes.md": 530,
    "docs/benchmarks.md": 470,
    "docs/notes/tried.md": 250,
    "docs/citation.md": 150,
}
"""Words of a page, all but those of generated tables."""
ALL = 12_300
LONGEST = 25
"""Words of a sentence."""
MADE = {f"docs/reference/{name}.md" for name in (*GROUPS, "rest", "scores", "verbs")}
"""Pages by docs/reference.py."""
PLAIN = {
    "alone": "only",
    "before black": "on a black background",
    "lifted": "brightened",
    "told": "said, listed or printed",
    "beside": "next to, or compared with",
    "befalls": "happens to",
    "as it is now": "nothing",
    "earlier": "nothing: a page has no history",
    "today": "nothing: a page has no history",
    "of somebody's": "of other people",
    "unless said otherwise": "the default, by name",
}
"""Words that readers stumble over, and what to write instead."""
ITEM = re.compile(r"^\s*(?:[-*+]|\d+\.)\s+", re.M)


def words(text: str) -> int:
    return sum(bool(re.search(r"\w", word)) for word in text.split())


def sentences(text: str) -> list[str]:
    """What a page's prose says, in pieces that end at a stop or a colon; items, cells and headings are their own."""
    lines = []
    for line in prose(text, "code").splitlines():
        line = re.sub(r"^[\s>]*(#+|!!!|\?\?\?\+?)\s", "\n\n", line)
        if line.lstrip().startswith("|"):
            line = "\n\n" + line.replace("|", "\n\n") + "\n\n"
        lines.append(ITEM.sub("\n\n", line) + ("\n" if line.startswith("\n\n") else ""))
    blocks = re.split(r"\n\s*\n", "\n".join(lines))
    return [" ".join(part.split()) for block in blocks for part in re.split(r"(?<=[.!?:;])[\"')*_]*\s", block)]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_words(page):
    assert name_of(page) in BUDGETS, "no budget for this page"
    assert words(by_hand(page.read_text(encoding="utf-8"))) <= BUDGETS[name_of(page)]


def test_words_in_all():
    assert sum(words(by_hand(page.read_text(encoding="utf-8"))) for page in PAGES) <= ALL


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_sentences_are_short(page):
    long = [f"{words(each)}: {each}" for each in sentences(page.read_text(encoding="utf-8")) if words(each) > LONGEST]
    assert not long, "\n".join(long)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_words_are_plain(page):
    text = " ".join(prose(page.read_text(encoding="utf-8"), "code").split())
    found = [
        f"...{text[max(hit.start() - 40, 0) : hit.end() + 20]}...: write {better}"
        for word, better in PLAIN.items()
        for hit in re.finditer(rf"\b{word}\b", text, re.IGNORECASE)
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"], ids=name_of)
def test_links_lead_somewhere(page):
    text = SPAN.sub("", FENCE.sub("", page.read_text(encoding="utf-8")))
    targets = [link[3] for link in LINK.finditer(text)]
    targets += [
        each for tag in re.findall(r"<[^<>]+>", text) for each in re.findall(r'(?:src|href|srcset)="([^"]+)"', tag)
    ]
    wrong = []
    for target in targets:
        path, _, anchor = target.partition("#")
        if re.match(r"\w+:", target):
            continue
        there = (page.parent / path).resolve() if path else page
        name = there.relative_to(ROOT).as_posix() if there.is_relative_to(ROOT) else path
        if name in MADE:
            continue
        if not there.exists() or (anchor and there.suffix == ".md" and anchor not in anchors(there.read_text("utf-8"))):
            wrong.append(target)
    assert not wrong, "\n".join(wrong)


def anchors(text: str) -> set[str]:
    """Of a page's headings, as GitHub and MkDocs make them, and those given with ``{#name}`` or ``id="name"``."""
    text = FENCE.sub("", text)
    found = set(re.findall(r"\{[^}\n]*#([\w-]+)[^}\n]*\}|id=\"([\w-]+)\"", text))
    named = {name for pair in found for name in pair if name}
    heads = [re.sub(r"\{[^}]*\}\s*$", "", head) for head in re.findall(r"^#+\s+(.*)$", text, re.M)]
    shown = [LINK.sub(lambda link: link[2], head).replace("`", "") for head in heads]
    return named | {re.sub(r"[\s]+", "-", re.sub(r"[^\w\s-]", "", head.lower()).strip()) for head in shown}


def test_what_a_sentence_is():
    text = (
        "# A head\n\nOne, two `ctm x y` (see [the page](x.md)): three. Four\nfive 3.5 six;\n\n"
        "- an item\n- another\n  goes on\n\n| a cell | b |\n|---|---|\n| c d | e |\n\n```\nno prose\n```\n"
    )
    found = [each for each in sentences(text) if words(each)]
    assert found == [
        "A head",
        "One, two code (see the page):",
        "three.",
        "Four five 3.5 six;",
        "an item",
        "another goes on",
        *("a cell", "b", "c d", "e"),
    ]


def test_anchors_of_headings():
    assert anchors('# What it `costs`, in [ms](x.md)\n## Two {#second}\n<a id="third"></a>\n') == {
        "what-it-costs-in-ms",
        "two",
        "second",
        "third",
    }
