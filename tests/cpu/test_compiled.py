"""Functions as machine code: where it is kept, and who may call it."""

import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numba
import pytest
import torch
from filelock import FileLock
from forked import Command, execute
from numba import prange

from ctm_plugin.cpu.compiled import compiled

SCRIPT = """
import torch
from ctm_plugin.rays.volume import volume_weights
print(volume_weights(torch.ones(4), torch.tensor([0, 0, 1, 1]), 2)[1].tolist())
"""


def run(told: Path, script: str = SCRIPT, warned: int = 0, **environment: str) -> str:
    """What a script says in a process that has torch imported, but not numba, which reads variables of its own then;
    so often it warns that what is compiled cannot be kept.
    """
    process = Command(script, main=execute, told=told, **environment)
    output, error = process.communicate()
    assert process.returncode == 0, error
    assert error.count("cannot be kept in") == warned
    return output


@compiled("void(f4[::1], f4[::1])")
def doubled(values, out):
    for i in prange(len(values)):
        out[i] = 2 * values[i]


def test_it_keeps_to_torch_s_threads():
    seen, before = [], torch.get_num_threads()
    for threads in (1, 2, 64):
        torch.set_num_threads(threads)
        try:
            doubled(torch.ones(3), torch.empty(3))
            seen.append(numba.get_num_threads())
        finally:
            torch.set_num_threads(before)
    assert seen == [min(threads, numba.config.NUMBA_NUM_THREADS) for threads in (1, 2, 64)]


@pytest.mark.slow
@pytest.mark.parametrize(("torch_s", "numba_s"), [("1", "2"), ("2", "1")])
def test_torch_s_threads_stay(torch_s, numba_s):
    """Starting numba's threads sets how many OpenMP gives to others."""
    script = SCRIPT + "print(torch.get_num_threads(), 'threads')"
    threads = {"OMP_NUM_THREADS": torch_s, "NUMBA_NUM_THREADS": numba_s}
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | threads, capture_output=True, text=True)
    assert f"{torch_s} threads" in done.stdout, done.stderr


@pytest.mark.parametrize("layer", ["omp", "workqueue"])
def test_two_threads_of_python_at_once(layer, tmp_path):
    """numba's own pool ends the process if nobody keeps them apart."""
    script = (
        "import torch\nfrom concurrent.futures import ThreadPoolExecutor\n"
        "from ctm_plugin.rays.volume import volume_weights\n"
        "ray = torch.arange(2000).repeat_interleave(50)\n"
        "with ThreadPoolExecutor(4) as pool:\n"
        "    found = list(pool.map(lambda _: volume_weights(torch.ones(100_000), ray, 2000)[1], range(40)))\n"
        "assert all(torch.equal(each, found[0]) for each in found)\n"
    )
    process = Command(script, main=execute, told=tmp_path / "told", NUMBA_THREADING_LAYER=layer)
    _, error = process.communicate()
    if "No threading layer" in error:
        pytest.skip(f"numba has no {layer} here")
    assert process.returncode == 0, error


def test_numba_switched_off(tmp_path):
    assert run(tmp_path / "told", NUMBA_DISABLE_JIT="1").startswith("[0.13533")


def test_without_a_folder_to_keep_it_in(tmp_path):
    """A package nobody may write to, and no home: compiled anew, said in a line."""
    own = "UserProvidedCacheLocator"
    locked = {"NUMBA_CACHE_LOCATOR_CLASSES": own, "NUMBA_CACHE_DIR": "", "NUMBA_DEBUG_CACHE": "1", "warned": 1}
    (printed,) = run(tmp_path / "told", **locked).splitlines()  # files loaded or saved would have lines of their own
    assert printed.startswith("[0.13533")


@pytest.fixture(scope="module")
def first(tmp_path_factory) -> tuple[Path, str]:
    """A folder in which one process has kept its code, and what that printed."""
    folder = tmp_path_factory.mktemp("first")
    said = run(tmp_path_factory.mktemp("told") / "first", NUMBA_CACHE_DIR=str(folder), NUMBA_DEBUG_CACHE="1")
    assert "[0.13533" in said
    return folder, said


@pytest.fixture
def kept(first, tmp_path) -> Path:
    """A copy of that folder, to change."""
    return Path(shutil.copytree(first[0], tmp_path / "kept"))


@pytest.mark.parametrize("kind", ["*.nbi", "*.nbc"])
def test_damaged_files_are_as_good_as_none(kind, kept, tmp_path):
    assert list(kept.rglob(kind))
    for path in kept.rglob(kind):
        path.write_bytes(path.read_bytes()[:40])
    assert "[0.13533" in run(tmp_path / "told", warned=1, NUMBA_CACHE_DIR=str(kept))


def test_what_cannot_be_compiled_is_tried_once(monkeypatch, recwarn):
    @compiled("void(f4[::1])")
    def wrong(values):
        values.no_such_thing()

    made, njit = [], numba.njit
    monkeypatch.setattr(numba, "njit", lambda **options: made.append(options) or njit(**options))
    with pytest.raises(numba.core.errors.TypingError, match="no_such_thing"):
        wrong(torch.ones(3))
    assert len(made) == 1
    assert not [each for each in recwarn if "cannot be kept" in str(each.message)]


def test_files_older_than_the_package_s_are_not_used(first, kept, tmp_path):
    """What a loop is made of may have changed, which numba does not see."""
    outcomes = ["data saved" in first[1]]
    for age in (0, 1e8):
        for path in kept.rglob("*.nbi"):
            os.utime(path, (time.time() - age,) * 2)
        said = run(tmp_path / f"told{age}", NUMBA_CACHE_DIR=str(kept), NUMBA_DEBUG_CACHE="1")
        outcomes.append("data saved" in said)
        assert "[0.13533" in said
    assert outcomes == [True, False, True]


def test_code_for_another_processor_is_not_used(first, kept, tmp_path):
    """numba keys what it keeps by the processor's name and features."""
    outcomes = ["data saved" in first[1]]
    for index, name in enumerate(({"NUMBA_CPU_NAME": "generic"}, {}, {"NUMBA_CPU_NAME": "generic"})):
        said = run(tmp_path / f"told{index}", NUMBA_CACHE_DIR=str(kept), NUMBA_DEBUG_CACHE="1", **name)
        outcomes.append("data saved" in said)
        assert "[0.13533" in said
    assert outcomes == [True, True, False, False]


@pytest.mark.slow
def test_one_process_at_a_time_compiles_a_function(kept, tmp_path):
    """Several that write numba's files at once may leave one signature's code under the key of another."""
    locks = [*kept.rglob("weights.*.lock")]
    for path in kept.rglob("*.nb?"):
        path.unlink()
    with ExitStack() as held:
        for each in locks:
            held.enter_context(FileLock(each))
        script = SCRIPT.replace("print", "print('imported', flush=True)\nprint", 1)
        waiting = Command(script, main=execute, told=tmp_path / "told", NUMBA_CACHE_DIR=str(kept))
        until = time.monotonic() + 60
        while "imported" not in waiting.said() and time.monotonic() < until:
            time.sleep(0.02)
        with pytest.raises(subprocess.TimeoutExpired):
            waiting.communicate(timeout=3)
        assert not list(kept.rglob("*.nbi"))
    assert "[0.13533" in waiting.communicate()[0]


@pytest.mark.parametrize("values", [torch.ones(3).double(), torch.ones(6)[::2], torch.ones(3, 1)])
def test_other_types(values):
    with pytest.raises(TypeError, match="No matching definition"):
        doubled(values, torch.empty(3))


def test_tensors_are_changed_in_place():
    values, out = torch.arange(5.0, requires_grad=True), torch.zeros(5)
    with ThreadPoolExecutor(1) as pool:  # thread counts of numba belong to a thread of Python
        pool.submit(doubled, values, out).result()
    assert out.tolist() == [0, 2, 4, 6, 8]
