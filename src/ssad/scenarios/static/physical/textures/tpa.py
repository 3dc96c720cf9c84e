"""TPA: a camouflage that moves a detector's attention from the target to its surroundings (paper V.B.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ssad.scenarios.static.physical.textures.attention import Redistribution
from ssad.scenarios.static.physical.textures.optimise import TextureAttack


def tpa(**settings: Any) -> TextureAttack:
    """Return the separable attention attack, in our reading (no code is public); optimised as `das`.

    Source: Zhang et al., Boosting Transferability of Physical Attack against Detectors by Redistributing Separable
    Attention (Pattern Recognition 138, 2023).
    """
    attack = TextureAttack("tpa", Redistribution(), epochs=200, rate=0.04, decay=1e-4)
    return replace(attack, **settings)
