"""Mutation testing of ``color``, ``rays`` and ``metrics``: how many small faults put into them do their tests notice?

``python tests/mutants.py [--sample N] [NAME ...]`` tests all mutants without a verdict; with names (wildcards allowed)
those; with ``--sample`` N of each file, drawn with a fixed seed. Folders, tests and what is left alone:
``[tool.mutmut]`` in ``pyproject.toml``. ``mutmut show NAME`` prints a mutant.
"""

import argparse
import random
from collections import Counter
from fnmatch import fnmatch

import jaxtyping
import torch.distributed.tensor  # noqa: F401  torch.testing imports it late, which would be most of a short test's time
from hypothesis import HealthCheck, Phase, settings
from mutmut.__main__ import _run
from mutmut.mutation.data import SourceFileMutationData
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.stats import status_by_exit_code
from mutmut.utils.file_utils import walk_mutatable_files
from mutmut.utils.format_utils import get_mutant_name

# The same examples for all mutants, and no shrinking, which is most of a failing test's time.
settings.register_profile(
    "mutants",
    max_examples=15,
    deadline=None,
    derandomize=True,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


def drawn(count: int, patterns: list[str]) -> list[str]:
    """Names of ``count`` mutants of each file, of all where there are fewer."""
    names = []
    for path in walk_mutatable_files():
        mutants = mutate_file_contents(str(path), path.read_text()).mutant_names
        mutants = [get_mutant_name(path, name) for name in mutants]
        random.Random(str(path)).shuffle(mutants)
        names += [name for name in mutants[:count] if any(fnmatch(name, pattern) for pattern in patterns)]
    return names


def report() -> None:
    """Print each survivor, and a line for each folder."""
    verdicts: dict[str, Counter[str]] = {}
    for path in walk_mutatable_files():
        data = SourceFileMutationData(path=path)
        data.load()
        for name, code in data.exit_code_by_key.items():
            verdict = status_by_exit_code[code]
            verdicts.setdefault(path.parent.name, Counter())[verdict] += 1
            if verdict not in ("killed", "not checked"):
                print(f"{verdict}: {name}")
    for folder, counts in verdicts.items():
        tested, killed = counts.total() - counts["not checked"], counts["killed"]
        print(f"{folder}: {killed} of {tested} killed, {killed / max(tested, 1):.1%}; {dict(counts)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--sample", type=int, metavar="N")
    given = parser.parse_args()
    # pytest's option for this refuses to be given twice in one process, as mutmut does.
    jaxtyping.install_import_hook("ctm_plugin", "beartype.beartype")
    _run(drawn(given.sample, given.names or ["*"]) if given.sample else given.names, max_children=1)
    report()


if __name__ == "__main__":
    main()
