"""Runs the numerical tests under settings that make one processor compute as others do: ``python tests/matrix.py``.

What differs between processors is which instructions torch's own loops, oneDNN, MKL and numba choose, and how many
threads share the work. Each setting below changes some of it; the tests hold under all, or a tolerance or the code is
wrong.

One changes the order of torch's sums on purpose, by ``reordered.py``: another order for each operator and each size,
the same for a call that is repeated, as ``tolerance.py`` has it. Under it run the numerical tests and those that train:
what is compared too closely is found on any machine.
``--only NAME`` runs some, ``--list`` says which there are; what follows ``--`` is pytest's.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time

AVX2 = "+avx,+avx2,+bmi,+bmi2,+cx16,+f16c,+fma,+fxsr,+lzcnt,+mmx,+movbe,+popcnt,+sse,+sse2,+sse3,+sse4.1,+sse4.2,+ssse3"
SETTINGS = {
    "for any processor": {
        "ATEN_CPU_CAPABILITY": "default",
        "MKL_CBWR": "COMPATIBLE",
        "NUMBA_CPU_NAME": "generic",
    },
    "all for AVX2": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "NUMBA_CPU_NAME": "haswell",
        "NUMBA_CPU_FEATURES": AVX2,
    },
    "two threads": {"OMP_NUM_THREADS": "2"},
    "sums in another order": {"CTM_REORDERED": "1"},
}
"""One thread where nothing else is said. MKL looks at neither torch's nor oneDNN's setting. Libraries that do not look
at one another's settings share one run; where it fails, each alone tells whose it is."""

ROOMS = ("appearance", "backbones", "color", "cpu", "metrics", "optim", "rays", "scene", "splats")
OF_DATA = ("degrade", "develop", "geometry", "lit_references", "near_far", "planar", "resample")
"""The tests of data that compute; the others read files."""
NUMERICAL = [f"tests/{name}" for name in (*ROOMS, *(f"data/test_{name}.py" for name in OF_DATA))]
LEFT_OUT = {
    "tests/cpu/test_compiled.py": "where machine code is kept and who may call it",
    "tests/cpu/test_allocator.py": "memory",
    "tests/cpu/test_products.py": "which library multiplies",
    "tests/backbones/test_dvgo.py::test_learns_colours_and_depth": "a whole training, to a bound on its score",
    "tests/backbones/test_barf2d.py::test_translations_are_found": "the same",
    "tests/backbones/test_nerf.py::test_training_learns": "the same",
    "tests/backbones/test_nerf.py::test_the_command": "a command line",
    "tests/backbones/test_barf2d.py::test_the_command_line": "a command line",
}
"""Slow tests, and what they are: run as they are alone."""
TRAINING = [f"tests/{name}" for name in (
    "callbacks", "runs/test_processes.py", "runs/test_resume.py", "runs/test_train.py",
    "test_other_device.py",
)]  # fmt: skip
"""More tests that train, for the setting that changes the order of sums."""


def run(name: str, more: list[str]) -> int:
    """The tests under one setting; pytest's exit code."""
    others = {key for each in SETTINGS.values() for key in each}
    environment = {key: value for key, value in os.environ.items() if key not in others}
    setting = {"OMP_NUM_THREADS": "1"} | SETTINGS[name]
    told = " ".join(f"{key}={value}" for key, value in setting.items())
    print(f"\n=== {name}: {told}", flush=True)
    begun, busy = time.monotonic(), busy_seconds()
    workers = 2 // int(setting["OMP_NUM_THREADS"])  # more threads than cores wait for one another
    command = [sys.executable, "-m", "pytest", "-q", "-n", str(workers), *NUMERICAL]
    command += TRAINING if "CTM_REORDERED" in setting else [f"--deselect={test}" for test in LEFT_OUT]
    command += more
    code = subprocess.run(command, env=environment | setting).returncode
    took = f"{time.monotonic() - begun:.0f} s, {busy_seconds() - busy:.0f} s of one core"
    print(f"=== {name}: {'passed' if code == 0 else 'FAILED'} in {took}", flush=True)
    return code


def busy_seconds() -> float:
    """What child processes have computed so far, which does not depend on what else the machine does."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", action="append", choices=SETTINGS, metavar="NAME")
    parser.add_argument("--list", action="store_true")
    parser.add_argument("more", nargs="*", help="for pytest, after --")
    args = parser.parse_args()
    if args.list:
        print("\n".join(SETTINGS))
        return 0
    failed = [name for name in args.only or SETTINGS if run(name, args.more)]
    print(f"\nmatrix: {'failed under ' + '; '.join(failed) if failed else 'passed under all settings'}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
