"""The C allocator's settings: a libc that writes down what it is told, and the real one in a process apart."""

import ctypes
import platform
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from ctm_plugin.cpu import allocator


class Libc:
    """``mallopt`` refuses some settings; glibc's constants are in malloc.h."""

    def __init__(self, refused=()):
        self.refused = refused
        self.told = {}

    def mallopt(self, name, value):
        self.told[name] = value
        return int(name not in self.refused)


@pytest.mark.parametrize("refused", [(), (-1,), (-2,), (-3,), (-1, -2, -3)], ids=str)
def test_settings(monkeypatch, refused):
    libc = Libc(refused)
    monkeypatch.setattr(ctypes, "CDLL", lambda name: libc)
    assert allocator.keep_memory() is (not refused)
    # All three are told, also after one was refused: M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD.
    assert libc.told == {-1: 2**31 - 1, -2: 2**26, -3: 2**29}


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_other_libraries(monkeypatch, error):
    def load(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", load)
    assert allocator.keep_memory() is False


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc only")
def test_real_libc():
    # A 64 MiB block comes from the heap, not from a mapping of its own. In a process apart: the settings stay.
    code = """
import ctypes
from ctm_plugin.cpu.allocator import keep_memory
print(keep_memory())
libc = ctypes.CDLL("libc.so.6")
libc.malloc.restype = libc.sbrk.restype = ctypes.c_void_p
libc.malloc.argtypes = [ctypes.c_size_t]
start = libc.sbrk(0)
block = libc.malloc(1 << 26)
print(libc.sbrk(0) - start >= 1 << 26)
"""
    root = Path(allocator.__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.split() == ["True", "True"]


def test_what_a_run_left_is_given_back(monkeypatch):
    class Ring:
        def __init__(self):
            self.me = self

    trimmed = []
    monkeypatch.setattr(ctypes, "CDLL", lambda name: type("Libc", (), {"malloc_trim": staticmethod(trimmed.append)}))
    left = weakref.ref(Ring())
    allocator.give_back()
    assert left() is None
    assert trimmed == [0]


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_nothing_to_give_back_to(monkeypatch, error):
    def load(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", load)
    allocator.give_back()
