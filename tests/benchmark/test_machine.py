"""Limits of the machine."""

import time

import torch

from ctm_plugin.benchmark.machine import best_seconds, describe

CPU = torch.device("cpu")


def test_the_least_time_is_taken_and_the_first_run_is_not_timed():
    waits = iter([0.2, 0.02, 0.001])
    assert 0.001 <= best_seconds(lambda: time.sleep(next(waits)), CPU, 2) < 0.02


def test_what_is_found():
    found = describe(CPU)
    assert found["torch"] == torch.__version__
    assert found["threads"] == torch.get_num_threads()
    for limit in ("float32_flops", "bfloat16_flops", "copy_bytes_per_second"):
        assert 1e8 < found[limit] < 1e16
