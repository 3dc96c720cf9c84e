"""Temporary eval mode of a network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def in_eval_mode(module: nn.Module) -> Iterator[None]:
    """Set all submodules to eval mode within the block, and restore the mode of each afterwards."""
    # Each submodule by itself: frozen norms of a network in training are in eval mode already.
    modes = [(submodule, submodule.training) for submodule in module.modules()]
    for submodule, _ in modes:
        submodule.training = False
    try:
        yield
    finally:
        for submodule, mode in modes:
            submodule.training = mode
