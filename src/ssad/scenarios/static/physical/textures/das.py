"""DAS: a camouflage that breaks up a detector's attention (paper V.B.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ssad.scenarios.static.physical.textures.attention import Distraction
from ssad.scenarios.static.physical.textures.optimise import TextureAttack


def das(**settings: Any) -> TextureAttack:
    """Return the dual attention suppression attack: the attention for the target falls into small, weak parts.

    The paper runs SGD with a learning rate of 0.01, a weight decay of 1e-4 and at most 200 epochs; the authors' code
    runs Adam. Adam is the default here, since it takes fewer epochs: attention is scaled to at most one, so the slope
    of a texel is small, and SGD at that rate moves it by less than a thousandth a step. `optimiser="sgd", rate=0.01`
    gives the paper's.

    Source: Wang et al., Dual Attention Suppression Attack: Generate Adversarial Camouflage in Physical World (2021).
    """
    attack = TextureAttack("das", Distraction(), epochs=200, rate=0.04, decay=1e-4)
    return replace(attack, **settings)
