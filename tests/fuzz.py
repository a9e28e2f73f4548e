"""Breaks valid data sets, runs and command lines at random: ``python tests/fuzz.py [--cases 600] [--seed 0]``.

Each case has a process of its own. It must work, or end in one of our own errors that names the file or the key; a
traceback, more than ``SECONDS``, more than ``MEMORY`` beyond what the process had, a file written elsewhere or code run
is a failure. What a failed case did is told with the arguments that do it again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from random import Random
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

sys.path += [str(Path(__file__).parent / "data"), str(Path(__file__).parents[1] / "docs" / "examples" / "ctm_scenes")]
from ctm_scenes.trajectory import hemisphere
from forked import PRELOAD, server
from layouts import HOUSE, blender_layout, colmap_layout, llff_layout, rawnerf_layout, transforms_layout
from mutations import TRACE, changed_tree, mutate, odd_value, places

from ctm_plugin import cli
from ctm_plugin.errors import ConfigError, CTMError, UnknownNameError
from ctm_plugin.runs.compose import compose

SECONDS = 60
MEMORY = 2**30
MESSAGE = 2000
"""Characters of the longest message that somebody reads."""


class Told(Exception):
    """A command's own error message, as it was printed."""


class Kind(NamedTuple):
    """What is broken.

    Attributes:
        make: writes a valid one into a new folder.
        use: reads it as a user would.
        files: how many of its files are changed, at most; 0 where ``use`` does all.
    """

    make: Callable[[Path], object]
    use: Callable[[Path, Random], object]
    files: int = 2


# Data sets.


def with_depth(root: Path) -> None:
    blender_layout(root, depth=True)


def house(root: Path) -> Path:
    """A ``transforms.json`` with a PNG, and JPEG and WebP pictures."""
    transforms_layout(root, hemisphere(6, 4.0, seed=3), **HOUSE)
    from PIL import Image

    content = json.loads((root / "transforms.json").read_text())
    for frame, ending in zip(content["frames"], ("jpg", "webp", "jpg", "webp"), strict=False):
        path = root / frame["file_path"]
        Image.open(path).save(path.with_suffix(f".{ending}"))
        path.unlink()
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(f".{ending}"))
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def wall(root: Path) -> None:
    llff_layout(root, (24, 16), 5)
    (root / "settings.json").write_text(json.dumps({"light": 0.5, "depth_scale": 0.1}))


def yard(root: Path) -> None:
    colmap_layout(root, hemisphere(5, 4.0, seed=3))


def dark_wall(root: Path) -> None:
    rawnerf_layout(root, np.full((32, 48, 3), 0.1), 4)


def photograph(root: Path) -> None:
    from PIL import Image

    root.mkdir(parents=True)
    picture = Image.fromarray(np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8))
    for ending in ("png", "jpg", "webp", "tif"):
        picture.save(root / f"a.{ending}")


def embedded(root: Path) -> None:
    from ctm_plugin.data.embedded import ASSETS

    shutil.copytree(ASSETS / "white_room" / "dark", root / "white_room" / "dark")


def use_scene(name: str, settings: dict[str, object], root: Path, random: Random) -> None:
    """Loads a data set by its registered name, with settings as a configuration has them."""
    from ctm_plugin.settings.build import build
    from ctm_plugin.settings.registry import DATASETS

    given = {"root": str(root), "downscale": random.choice((1, 1, 2)), "skip": random.choice((1, 1, 2)), **settings}
    check_scene(build(DATASETS.get(name), given, "dataset").load())


def scene(name: str, **settings: object) -> Callable[[Path, Random], None]:
    return partial(use_scene, name, settings)


def check_scene(loaded) -> None:
    """Whatever was loaded can be trained on: nothing in it is NaN."""
    assert 0 <= loaded.near < loaded.far < float("inf")
    for views in (loaded.train, loaded.test):
        assert views.c2w.isfinite().all()
        assert views.intrinsics.isfinite().all()


def use_photograph(root: Path, random: Random) -> None:
    from ctm_plugin.data.planar import PlanarConfig

    path = root / f"a.{random.choice(('png', 'png', 'jpg', 'webp', 'tif'))}"
    loaded = PlanarConfig(image=path, height=30, width=40, patch=12).load()
    assert loaded.image.isfinite().all()


def use_embedded(root: Path, random: Random) -> None:
    from ctm_plugin.data import embedded

    embedded.ASSETS = root
    check_scene(embedded.WhiteRoomConfig(light="dark").load())


# Runs.


def run(root: Path) -> None:
    """Two finished runs, without CTM and with it, of a data set beside them."""
    blender_layout(root / "data", depth=True)
    small = ["dataset=blender", f"dataset.root={root / 'data'}", "trainer=smoke", "trainer.precision=32-true",
             "backbone.coarse=false", "backbone.steps_alone=3", "backbone.grow=[]", "backbone.rays=16",
             "backbone.voxels=512", "trainer.log_every=1", "trainer.image_every=2",
             "trainer.checkpoint_every=1"]  # fmt: skip
    for ctm, more in (("off", []), ("on", ["ctm.pretrain_steps=3"])):
        with quiet() as said:
            code = cli.main([*small, f"ctm={ctm}", *more, f"hydra.run.dir={root / 'runs' / ctm}"])
        assert code == 0, said.getvalue()


def command(arguments: list[str], main: Callable[[list[str]], int] = cli.main) -> None:
    """Runs a command of ours; its exit code, its message and the error behind that say how it ended."""
    errors = []

    def noticed(self: CTMError, *text: object) -> None:
        Exception.__init__(self, *text)
        errors.append(self)

    with quiet() as said, patch.object(CTMError, "__init__", noticed):
        code = main(arguments)
    if code:
        told = next((line for line in said.getvalue().splitlines() if line.startswith("error: ")), said.getvalue())
        raise Told(told) from next((error for error in reversed(errors) if str(error) in told), None)


@contextlib.contextmanager
def quiet():
    """Standard output and error, caught."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        yield said


def use_run(root: Path, random: Random) -> None:
    name = root / "runs" / "on"
    which = random.randrange(4)
    if which == 0:
        command(["evaluate", str(name)])
    elif which == 1:
        path = random.choice(("orbit", "test"))
        command(["render", str(name), "frames=1", f"path={path}", f"out={root / 'a.gif'}"])
    elif which == 2:
        command([f"resume={name / 'checkpoints' / 'previous.ckpt'}"])
    else:
        command([f"resume={name}"])


def use_report(root: Path, random: Random) -> None:
    """Any format, and the tables that show these two runs."""
    which = random.randrange(5)
    if which == 0:
        asked = f"format={random.choice(('md', 'csv', 'latex'))}"
    elif which == 1:
        asked = f"table={random.choice('124567')}"
    else:
        asked = "format=html"
    command(["report", str(root / "runs"), f"out={root / 'report'}", asked])


def weights(root: Path) -> None:
    import torch

    from ctm_plugin.metrics.lpips import feature_network

    root.mkdir(parents=True)
    state = {f"features.{name}": value for name, value in feature_network("alex").state_dict().items()}
    torch.save(state, root / "w.pth")
    np.savez(root / "w.npz", **{name: value.numpy() for name, value in state.items()})


def use_weights(root: Path, random: Random) -> None:
    from ctm_plugin.metrics.lpips_weights import load_lpips

    load_lpips(root / random.choice(("w.pth", "w.npz")), "alex")


# Command lines.


def use_command_line(root: Path, random: Random) -> None:
    """Keys with values that they do not expect; all is built, nothing trained."""
    from ctm_plugin.runs import train
    from ctm_plugin.runs.assemble import assemble

    def only_assemble(config, folder, tell):
        assemble(config)
        return {}

    train.train = only_assemble
    backbone = random.choice(("dvgo", "nerf"))
    arguments = ["dataset=blender", f"dataset.root={root}", f"backbone={backbone}", "trainer=smoke", "ctm=on"]
    config = compose(*arguments)
    keys = [".".join(map(str, path)) for path in places(config) if "root" not in path]
    for _ in range(random.randint(1, 2)):
        key = random.choice(keys)
        value = odd_value(random)
        text = value if isinstance(value, str) and random.random() < 0.5 else json.dumps(value)
        arguments.append(f"{random.choice(('', '', '', '+', '++', '~'))}{key}={text}")
    command([*arguments, f"hydra.run.dir={root / 'out'}"])


def use_tree(root: Path, random: Random) -> None:
    """A configuration from a program: a whole nest, changed anywhere."""
    from ctm_plugin.runs.assemble import assemble

    config = compose(
        "dataset=blender",
        f"dataset.root={root}",
        "trainer=smoke",
        "ctm=on",
        "backbone=" + random.choice(("dvgo", "nerf")),
    )
    changed = changed_tree(config, random)
    if not isinstance(changed, dict):
        changed = {}
    assemble(changed)


KINDS = {
    "blender": Kind(with_depth, scene("blender")),
    "llff": Kind(wall, scene("llff", test_every=2)),
    "transforms": Kind(house, scene("transforms", test_every=2)),
    "colmap": Kind(yard, scene("colmap", test_every=2)),
    "rawnerf": Kind(dark_wall, scene("rawnerf", background="black", test_every=2)),
    "planar": Kind(photograph, use_photograph, 4),
    "embedded": Kind(embedded, use_embedded),
    "run": Kind(run, use_run),
    "report": Kind(run, use_report, 3),
    "weights": Kind(weights, use_weights),
    "command line": Kind(blender_layout, use_command_line, 0),
    "configuration": Kind(blender_layout, use_tree, 0),
}  # fmt: skip


def break_files(root: Path, random: Random, most: int, outside: Path) -> str:
    """Changes some files of a folder, each kind of file as likely; what was done."""
    whole, done = sorted(path for path in root.rglob("*") if path.is_file()), []
    for _ in range(random.randint(1, most) if most else 0):
        ending = random.choice(sorted({path.suffix for path in whole}))
        path = random.choice([path for path in whole if path.suffix == ending])
        whole.remove(path)
        done.append(f"{path.relative_to(root)} {mutate(path, random, outside)}")
    return ", ".join(done)


def outcome(use: Callable[[Path, Random], object], root: Path, random: Random, keys: bool) -> tuple[str, str]:
    """How using a broken folder ended: ``worked``, ``told`` or ``failed``, and what was said.

    ``keys``: it is a command line's keys that are broken, so that naming one of them is enough.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            use(root, random)
        ended = "worked", ""
    except (CTMError, Told) as error:
        ended = judged(error, root, keys)
    except BaseException:
        ended = "failed", traceback.format_exc()
    grown = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    return ("failed", f"{grown >> 20} MiB of memory; {ended}") if grown > MEMORY else ended


KEY = re.compile(r"^error: (\S.*: (found|expected) |unknown |Could not |Key |force-add of |Error merging override )")
"""How a command begins to tell what is wrong with a key."""


def judged(error: Exception, root: Path, keys: bool) -> tuple[str, str]:
    """Whether an error of ours says where, in one line, and did not come because memory ran out."""
    text, cause = str(error), error
    while cause is not None:
        if isinstance(cause, MemoryError) or "can't allocate memory" in str(cause):
            return "failed", f"refused for want of memory alone: {text}"
        cause = cause.__cause__ or cause.__context__
    if len(text) > MESSAGE:
        return "failed", f"a message of {len(text)} characters: {text[:300]}"
    if isinstance(error, Told) and not text.startswith("error: "):
        return "failed", f"no error of ours: {text[-1000:]}"
    if not (str(root) in text or (keys and (isinstance(error, ConfigError | UnknownNameError) or KEY.match(text)))):
        return "failed", f"does not say where: {text}"
    return "told", text


def work(use: Callable[[Path, Random], object], root: Path, seed: str, keys: bool, pipe: Connection) -> None:
    """One case, in a process that may end in any way."""
    os.chdir(root)
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + 4 * MEMORY,) * 2)
    pipe.send(outcome(use, root, Random(seed), keys))


class Fuzzer:
    """Cases by kind, seed and number, each in a process forked from one that has imported everything.

    Args:
        folder: for valid originals and their broken copies.
        preload: modules that are imported once.
    """

    def __init__(self, folder: Path, preload: Sequence[str] = PRELOAD):
        self.folder = folder
        self.context = server(preload)
        (folder / "original").mkdir()
        self.outside = folder / "outside"
        self.outside.mkdir()

    def case(self, kind: str, seed: int, number: int) -> tuple[str, str, str]:
        """Run one: what was done to the files, how it ended, what was said."""
        chosen = KINDS[kind]
        random = Random(f"{seed}/{kind}/{number}")
        # Runs hold their own path, so that copies have to lie where the original was made.
        root, original = (self.folder / where / chosen.make.__name__ for where in ("copy", "original"))
        if not original.exists():
            chosen.make(root)
            root.rename(original)
        shutil.copytree(original, root, copy_function=os.link)
        done = break_files(root, random, chosen.files, self.outside)
        ended, said = self.run(chosen.use, root, f"{seed}/{kind}/{number}/use", keys=not chosen.files)
        if (root / TRACE).exists():
            ended, said = "failed", f"code was run; {said}"
        shutil.rmtree(root)
        return done, ended, said

    def run(
        self, use: Callable[[Path, Random], object], root: Path, seed: str, seconds: int = SECONDS, keys: bool = False
    ) -> tuple[str, str]:
        ours, theirs = self.context.Pipe(duplex=False)
        process = self.context.Process(target=work, args=(use, root, seed, keys, theirs))
        process.start()
        theirs.close()
        try:
            # Second by second: this process may itself be stopped for a while, as on a machine that is shared.
            done = any(ours.poll(1) for _ in range(seconds))
            ended = ours.recv() if done else ("failed", f"not done after {seconds} s")
        except EOFError:
            process.join()
            ended = "failed", f"the process ended with {process.exitcode}"
        process.kill()
        process.join()
        return ended


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--cases", type=int, default=600, help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=KINDS, help="only these")
    parser.add_argument("--case", type=int, help="only the case of this number, of one kind")
    args = parser.parse_args()
    os.environ |= {"TORCH_HOME": "/nonexistent", "https_proxy": "http://127.0.0.1:9"}
    kinds = args.kind or list(KINDS)
    counts = {kind: Counter() for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(Path(folder))
        numbers = range(args.cases // len(kinds)) if args.case is None else [args.case]
        for kind in kinds:
            for number in numbers:
                done, ended, said = fuzzer.case(kind, args.seed, number)
                counts[kind][ended] += 1
                if ended == "failed" or args.case is not None:
                    print(f"{ended}: --kind '{kind}' --seed {args.seed} --case {number}: {done}\n{said}\n", flush=True)
            print(f"{kind}: {dict(counts[kind])}", file=sys.stderr, flush=True)
    print("| kind | tried | worked | told | failed |\n|---|---|---|---|---|")
    total = sum(counts.values(), Counter())
    for kind, count in [*counts.items(), ("all", total)]:
        print(f"| {kind} | {count.total()} | {count['worked']} | {count['told']} | {count['failed']} |")
    return int(total["failed"] > 0)


if __name__ == "__main__":
    sys.exit(main())
