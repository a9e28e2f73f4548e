"""One of several processes that torchrun started: the command line, then this process' weights into a file."""

import os
import sys
from pathlib import Path

import torch

from ctm_plugin import cli
from ctm_plugin.callbacks.checkpoint import RunInfo

out = Path(sys.argv[1])
RunInfo.on_train_end = lambda self, trainer, module: torch.save(
    {"weights": module.state_dict(), "optimizer": module.named_optimizers.state_dict(), "batches": module.batches_seen},
    out / f"rank{os.environ['LOCAL_RANK']}.pt",
)
sys.exit(cli.main(sys.argv[2:]))
