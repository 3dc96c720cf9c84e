"""Adv. Patch: one patch for all images, trained to lower the best score on its target (paper V.B.2)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ssad.scenarios.static.digital.objectives import Hide
from ssad.scenarios.static.physical.textures.optimise import TextureAttack


def adv_patch(**settings: Any) -> TextureAttack:
    """Return the patch attack of the paper.

    Adam with a learning rate of 0.04 and an epsilon of 1e-8 for at most 200 epochs, as in the paper; the scores on
    the target go down under changes of print and place. A detector proposes a car many times: with the best box alone
    another takes its place at each step, so the best 20 count.

    Source: Shrestha et al., Towards a Robust Adversarial Patch Attack (2023); Thys et al., Fooling Automated
    Surveillance Cameras (2019), for the loss and the kinds of regularisers.
    """
    return replace(TextureAttack("adv-patch", Hide(others=20), epochs=200, rate=0.04), **settings)
