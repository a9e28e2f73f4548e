"""DVGO's step with sparse gradients of its tables beside the same step with dense ones, in turns, on two grids.

``python benchmarks/sparse_step.py [key=value ...]``, as on the command line of ``ctm_plugin``.
"""

from __future__ import annotations

import statistics
import sys
import time

from hydra import compose, initialize_config_dir

from ctm_plugin.allocator import keep_memory
from ctm_plugin.assemble import assemble
from ctm_plugin.benchmark.subject import Side, warm
from ctm_plugin.cli import conf_dir, resolved
from ctm_plugin.products import fast_products

WARM_UP, STEPS = 1400, 60


def main(overrides: list[str]) -> None:
    keep_memory()
    for side in (64, 160):
        chosen = ["backbone=dvgo", "trainer=quick", "ctm=off", *overrides, f"backbone.voxels={side**3}"]
        with initialize_config_dir(str(conf_dir()), version_base="1.3"):
            parts = assemble(resolved(compose("config", chosen)))
        device, bf16 = warm(parts, WARM_UP)
        subject, times = Side(parts.backbone, parts.attach, bf16), {True: [], False: []}
        with fast_products(device):
            for step in range(STEPS):
                for sparse in (True, False)[:: 1 if step % 2 else -1]:
                    subject.module.sparse = sparse
                    start = time.perf_counter()
                    subject.step()
                    times[sparse].append(time.perf_counter() - start)
        found = {sparse: statistics.median(those[4:]) * 1e3 for sparse, those in times.items()}
        print(f"{side}^3: sparse {found[True]:.1f} ms, dense {found[False]:.1f} ms a step, ", end="")
        print(f"ratio {found[False] / found[True]:.2f}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
