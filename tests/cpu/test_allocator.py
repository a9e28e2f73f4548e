"""The C allocator's settings, with the real libc in a process apart: the settings stay."""

import ctypes
import platform
import subprocess
import sys
import weakref
from pathlib import Path

import pytest

from ctm_plugin.cpu import allocator


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc only")
def test_large_blocks_come_from_the_heap():
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


def test_what_a_run_left_is_given_back():
    class Ring:
        def __init__(self):
            self.me = self

    left = weakref.ref(Ring())
    allocator.give_back()
    assert left() is None


@pytest.mark.parametrize("error", [OSError, AttributeError])
def test_elsewhere_than_on_glibc_nothing_happens(monkeypatch, error):
    def load(name):
        raise error

    monkeypatch.setattr(ctypes, "CDLL", load)
    assert allocator.keep_memory() is False
    allocator.give_back()
