"""The optimisers of both networks: Muon for hidden weights, Adam for the rest."""

from typing import Any

import torch
from torch import nn

from mi_ring.fitting.config import Config
from mi_ring.fitting.muon import Muon
from mi_ring.system.machine import has_fast_bfloat16


def optimizers_of(networks: nn.Module, config: Config, device: torch.device) -> list[torch.optim.Optimizer]:
    """Muon for the hidden weight matrices and Adam for everything else, or Adam for all.

    Hidden are the layers that a network, or a part of it, holds as `hidden`, an `nn.ModuleList` of linear ones.
    """
    lists = [getattr(part, "hidden", None) for part in networks.modules()]
    hidden: list[Any] = [
        layer.weight
        for layers in lists
        if isinstance(layers, nn.ModuleList)
        for layer in layers
        if isinstance(layer, nn.Linear)
    ]
    hidden = hidden if config.optimizer == "muon" else []
    rest = [p for p in networks.parameters() if not any(p is h for h in hidden)]
    result: list[torch.optim.Optimizer] = [torch.optim.Adam(rest, lr=config.learning_rate)]
    if hidden:
        fast = config.precision != "float32" and has_fast_bfloat16(device)
        dtype = torch.bfloat16 if fast else torch.float32
        result.append(Muon(hidden, lr=config.muon_rate, dtype=dtype))
    for optimizer in result:
        for group in optimizer.param_groups:
            group["initial_lr"] = group["lr"]
    return result
