"""What several processes need when a model's parameters change their size."""

from __future__ import annotations

import lightning as L
from lightning.pytorch.strategies import DDPStrategy


def rewrap(trainer: L.Trainer) -> None:
    """Wrap the model for DDP anew: its gradient buckets are laid out for the parameters it was wrapped with."""
    strategy = trainer.strategy
    if isinstance(strategy, DDPStrategy) and strategy.model is not strategy.lightning_module:
        strategy.model = strategy._setup_model(strategy.lightning_module)
