"""One of several processes that torchrun started: the command line, then this process' weights into a file."""

import os
import sys
from pathlib import Path

import torch

from ctm_plugin import cli
from ctm_plugin.callbacks.checkpoint import RunInfo


def main(arguments: list[str]) -> int:
    """The command line after a folder for ``rank*.pt``."""
    out = Path(arguments[0]) / f"rank{os.environ['LOCAL_RANK']}.pt"
    RunInfo.on_train_end = lambda self, trainer, module: torch.save(
        {
            "weights": module.state_dict(),
            "optimizer": module.named_optimizers.state_dict(),
            "batches": module.batches_seen,
        },
        out,
    )
    return cli.main(arguments[1:])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
