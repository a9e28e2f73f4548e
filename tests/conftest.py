"""Fixtures that all tests share."""

import copy
import functools
import gc
import json
import math
import os
import shutil
import signal
import tarfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import jaxtyping
import numpy as np
import pytest
import type_checks
from filelock import FileLock
from hypothesis import settings
from PIL import Image

# CPUs alone give results bit for bit, as many tests want them: a GPU adds up in any order. Child processes see none.
if "CTM_TEST_GPU" not in os.environ:  # see test_gpu.py
    os.environ["CUDA_VISIBLE_DEVICES"] = ""

# What takes long to import is imported where it is used: the process that hands out the tests reads this file too.

jaxtyping.jaxtyped = type_checks.jaxtyped  # before the package is imported
if "CTM_REORDERED" in os.environ:  # see matrix.py
    import reordered  # noqa: F401

# Shared machines stall now and then: a deadline an example would fail tests for nothing. Other examples each time, and
# more than the 15 with which mutants.py measures what they notice; of 100 each, most of the time went into the rest.
settings.register_profile("ctm", deadline=None, max_examples=20)
settings.load_profile("ctm")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Each worker begins with neighbouring tests, which share what a module makes; in the end it takes over others'.

    By default neighbours are dealt out, and every worker makes it all. A mode chosen with ``--dist`` stays.
    """
    if config.getvalue("dist") != "load":
        return None
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The second of two workers begins with what runs no loops, else it waits while the first compiles them."""
    plain = ("test_conf.py", "test_mistakes.py", "test_command_lines.py")
    without, others = ([each for each in items if (each.path.name in plain) is of] for of in (True, False))
    half = len(items) // 2
    items[:] = [*others[:half], *without, *others[half:]]


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, Any, Any]:
    """What has been imported stays: no garbage is looked for while it is, nor in it by what every run asks for."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_runtest_setup() -> None:
    """A test's weights are the same whichever tests ran before it."""
    import torch

    torch.manual_seed(0)


@pytest.fixture(scope="session", autouse=True)
def offline(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No weights of LPIPS, neither from this machine's cache nor from the network, in child processes too.

    Of the session, so that it comes before fixtures of any scope that train.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch_home")))
        patch.setenv("https_proxy", "http://127.0.0.1:9")
        patch.setenv("no_proxy", "127.0.0.1")
        yield


@pytest.fixture(scope="session", autouse=True)
def event_files() -> None:
    """All of TensorBoard's files get as many digits.

    It reads them in the order of their names, which end in a counter. Among files of one second, as tests write them,
    number 10 comes before number 9, and what a later file replaces comes back.
    """
    from tensorboard.summary.writer import event_file_writer

    event_file_writer._global_uid = event_file_writer.AtomicCounter(10**6)


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, Callable[[Path], Any]], Path]:
    """``once(name, make)``: a folder that ``make`` fills, for all processes of pytest; tests leave it as it is."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent

    def made(name: str, make: Callable[[Path], Any]) -> Path:
        done = folder / f"{name}.done"
        with FileLock(folder / f"{name}.lock"):
            if not done.exists():
                make(folder / name)
                done.touch()
        return folder / name

    return made


@pytest.fixture(scope="session")
def trained(once: Callable[..., Path]) -> Callable[..., Path]:
    """``trained(name, *arguments)``: the run of a command line, made once; tests leave it as it is."""
    from ctm_plugin.cli import main

    def run(name: str, *arguments: str) -> Path:
        def make(folder: Path) -> None:
            assert main([*arguments, f"hydra.run.dir={folder}"]) == 0

        return once(name, make)

    return run


@pytest.fixture(scope="session")
def splat_run(ball, trained) -> Path:
    """The dark ball in Gaussian splats, rendered as whole pictures."""
    sizes = ("backbone=splat", "trainer=smoke", "backbone.steps=150", "ctm=auto")
    return trained(
        "viewed_splats",
        "dataset=blender",
        "dataset.exposure=0.05",
        f"dataset.root={ball}",
        "dataset.background=black",
        *sizes,
    )


@pytest.fixture(scope="session")
def sdist(once: Callable[..., Path]) -> Path:
    """The package's sdist, as it is unpacked."""
    from hatchling.builders.sdist import SdistBuilder

    def make(folder: Path) -> None:
        archive = next(SdistBuilder(str(Path(__file__).parents[1])).build(directory=str(folder)))
        with tarfile.open(archive) as content:
            content.extractall(folder, filter="data")

    return next(path.parent for path in once("sdist", make).glob("*/PKG-INFO"))


@pytest.fixture(scope="session")
def wheel(once: Callable[..., Path], sdist: Path) -> Path:
    """The wheel that the sdist makes."""
    from hatchling.builders.wheel import WheelBuilder

    def make(folder: Path) -> None:
        before = os.getcwd()
        next(WheelBuilder(str(sdist)).build(directory=str(folder), versions=["standard"]))
        assert os.getcwd() == before

    return next(once("wheel", make).glob("*.whl"))


@pytest.fixture(scope="session")
def ctm_data() -> Path:
    """Folder of the real data sets: ``CTM_DATA``, by default ``../shared/data`` beside the repository."""
    default = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("CTM_DATA") or default)
    if not folder.is_dir():
        why = f"real data not found at {folder}; set CTM_DATA to their folder"
        # On CI a missing folder is a broken set-up: skipping would turn it green.
        pytest.fail(why) if os.environ.get("CI") else pytest.skip(why)
    return folder


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """The package in ``tests/outside``, on the path and found by its metadata as an installed one is, for one test."""
    from hydra.core.config_store import ConfigStore

    from ctm_plugin.compose.command_line import GROUPS
    from ctm_plugin.metrics import table

    folder = Path(__file__).parent / "outside"
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(folder)
    repo, ours = ConfigStore.instance().repo, dict(table.METRICS)
    choices = {group: dict(repo.get(group, {})) for group in GROUPS}
    table.add_others.cache_clear()
    yield folder
    repo.update(choices)
    table.add_others.cache_clear()
    table.METRICS.clear()
    table.METRICS.update(ours)


@functools.cache
def _configuration(*arguments: str) -> dict[str, Any]:
    from ctm_plugin.compose.command_line import compose

    return compose(*arguments)


@pytest.fixture(scope="session")
def composed() -> Callable[..., dict[str, Any]]:
    """``composed(*arguments)``: the resolved configuration of a command line, to be changed at will."""
    return lambda *arguments: copy.deepcopy(_configuration(*arguments))


@pytest.fixture(scope="session")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set in Blender layout small enough to train on in a second: a ball in 8 + 2 views of 12x12."""
    from ctm_scenes.trajectory import hemisphere

    root = tmp_path_factory.mktemp("data") / "ball"
    size, angle, radius = 12, 0.6, 0.8
    axis = (np.arange(size) + 0.5 - size / 2) / (size / 2) * math.tan(angle / 2)
    for split, count in (("train", 8), ("test", 2)):
        (root / split).mkdir(parents=True)
        content = {"camera_angle_x": angle, "near": 2.0, "far": 6.0, "depth_scale": 1e-4, "frames": []}
        for index, pose in enumerate(hemisphere(count, 4.0, seed=len(split))):
            x, y = np.meshgrid(axis, -axis)
            rays = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            middle = -rays @ pose[:3, 3]
            inside = radius**2 - (pose[:3, 3] @ pose[:3, 3] - middle**2)
            depth = np.where(inside > 0, middle - np.sqrt(inside.clip(0)), 0)
            color = (pose[:3, 3] + rays * depth[..., None]) / radius / 2 + 0.5
            picture = np.concatenate([color, np.ones_like(color[..., :1])], axis=-1) * (inside > 0)[..., None]
            Image.fromarray((picture.clip(0, 1) * 255).round().astype(np.uint8)).save(root / f"{split}/r_{index}.png")
            Image.fromarray((depth / 1e-4).round().astype(np.uint16)).save(root / f"{split}/r_{index}_depth.png")
            frame = {"file_path": f"./{split}/r_{index}", "transform_matrix": pose.tolist()}
            content["frames"].append(frame | {"depth_file_path": f"./{split}/r_{index}_depth.png"})
        (root / f"transforms_{split}.json").write_text(json.dumps(content))
    return root


@pytest.fixture(scope="session")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A forward-facing data set in LLFF's layout: a painted wall at 6 and a board at 3, 17 views of 24x20, depth."""
    from ctm_scenes.layouts import write_poses_bounds
    from ctm_scenes.trajectory import forward_facing

    root = tmp_path_factory.mktemp("data") / "hall"
    (root / "images").mkdir(parents=True)
    (root / "depth").mkdir()
    width, height, angle, wall, front = 24, 20, 0.8, 6.0, 3.0
    focal = 0.5 * width / math.tan(0.5 * angle)
    poses = forward_facing(17, np.zeros(3), np.array([0.0, 1.0, 0.0]), (1.0, 0.8), seed=1)
    for index, pose in enumerate(poses):
        x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
        ray = np.stack([x / focal, -y / focal, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        board = pose[:3, 3] + (front - pose[1, 3]) / ray[..., 1:2] * ray
        on_board = (np.abs(board[..., 0] - 0.2) < 0.6) & (np.abs(board[..., 2]) < 0.5)
        along = np.where(on_board, front - pose[1, 3], wall - pose[1, 3]) / ray[..., 1]
        across, _, up = np.moveaxis(pose[:3, 3] + along[..., None] * ray, -1, 0)
        pitch = np.where(on_board, 6.0, 2.5)
        waves = [np.sin(pitch * across), np.cos(pitch * up), np.sin(pitch * (across + up))]
        picture = (127.5 + 110 * np.stack(waves, axis=-1)).astype(np.uint8)
        Image.fromarray(picture).save(root / f"images/{index:02d}.png")
        np.save(root / f"depth/{index:02d}.npy", along.astype(np.float32))
    write_poses_bounds(root, poses, angle, (width, height), np.tile([front - 0.5, wall + 1.0], (len(poses), 1)))
    return root


@pytest.fixture(scope="session")
def arguments(ball: Path) -> tuple[str, ...]:
    """Command-line arguments that make a whole DVGO training take a second."""
    return ("dataset=blender", f"dataset.root={ball}", "ctm=on", "trainer=smoke")


@pytest.fixture(scope="session")
def compose(arguments: tuple[str, ...], composed: Callable[..., dict[str, Any]]) -> Callable[..., dict[str, Any]]:
    """The configuration that the command line gives for these arguments after the small ones.

    Another data set than the ball comes with its own keys.
    """

    def configuration(*more: str) -> dict[str, Any]:
        small = arguments[2:] if any(a.lstrip("+").startswith("dataset=") for a in more) else arguments
        return composed(*small, *more)

    return configuration


@pytest.fixture
def small(ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    """Arguments of a run of a fraction of a second, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    sizes = ("trainer=smoke", "backbone.coarse=false", "backbone.steps_alone=3", "backbone.grow=[2]")
    return ("dataset=blender", f"dataset.root={ball}", *sizes)


@pytest.fixture
def untrained(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training is an error."""

    def fit(*_: Any, **__: Any) -> None:
        raise AssertionError("training has begun")

    monkeypatch.setattr("lightning.Trainer.fit", fit)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """``refused(*arguments)``: what is said of a command line that ends with one message."""
    from ctm_plugin.cli import main

    def said(*arguments: object) -> str:
        assert main(list(map(str, arguments))) == 1
        error = capsys.readouterr().err
        assert error.count("error: ") == 1
        assert "Traceback" not in error
        return error

    return said


@pytest.fixture
def ctrl_c(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Press Ctrl-C in the middle of the batches that a predicate tells."""
    from ctm_plugin.backbones.base import Backbone

    step = Backbone.training_step

    def press(when: Callable[[int], bool], number: signal.Signals = signal.SIGINT) -> None:
        def training_step(self: Backbone, *args: Any) -> Any:
            if when(self.batches_seen):
                signal.raise_signal(number)
            return step(self, *args)

        monkeypatch.setattr(Backbone, "training_step", training_step)

    return press


@pytest.fixture(scope="module")
def whole(config: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of a test module's ``config``, which nothing interrupted; tests leave it as it is."""
    from ctm_plugin.runs.train import train

    run = tmp_path_factory.mktemp("whole") / "run"
    train(config, run)
    return run


@pytest.fixture
def finished(whole: Path, tmp_path: Path) -> Path:
    """A copy of ``whole``, to break."""
    return Path(shutil.copytree(whole, tmp_path / "finished"))
