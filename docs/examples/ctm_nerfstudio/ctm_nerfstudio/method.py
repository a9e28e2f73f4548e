"""``ns-train ctm-nerfacto``: nerfacto's own settings, in whatever version, with a transform and its optimizer."""

from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
import tyro
from nerfstudio.configs.method_configs import method_configs
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.plugins.types import MethodSpecification

from ctm_nerfstudio.model import CTMNerfactoConfig

# Nerfstudio's schedules put NumPy's numbers into checkpoints, which torch >= 2.6 else refuses to read again.
torch.serialization.add_safe_globals([np.core.multiarray.scalar, np.dtype, np.dtypes.Float64DType])


@dataclass
class TransformAdamConfig(AdamOptimizerConfig):
    """The transform's Adam. Its rate and betas are ``ctm.lr`` and ``ctm.betas`` of the model's ``colors``."""

    lr: tyro.conf.Suppress[float] = 5e-4
    max_norm: tyro.conf.Suppress[float | None] = None


config = deepcopy(method_configs["nerfacto"])
config.method_name = "ctm-nerfacto"
given = {key: value for key, value in vars(config.pipeline.model).items() if key != "_target"}
config.pipeline.model = CTMNerfactoConfig(**given)
config.optimizers["ctm"] = {"optimizer": TransformAdamConfig(), "scheduler": None}

method = MethodSpecification(config, "Nerfacto, trained in the colours of a colour transform: dark scenes.")
