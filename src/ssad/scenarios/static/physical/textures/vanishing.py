"""Vanishing camouflage: suppresses every box on the target over views, light and print."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ssad.scenarios.static.physical.textures.optimise import TextureAttack


def vanishing(**settings: Any) -> TextureAttack:
    """Return the loss of ACTIVE and RAUCA on a texture of the whole paint, with the scores of all classes.

    The source lowers the score of the target's own class (`objective="hide"`), which leaves the target detected as
    another class in most images. Half of each epoch's images are those on which the attack performs worst, as in
    R-PGA.

    Source: Suryanto et al., ACTIVE (2023); Zhou et al., RAUCA (2024); the mining of views: R-PGA (2026).
    """
    attack = TextureAttack("vanishing", "hide-any", epochs=40, rate=0.04, worst=0.5)
    return replace(attack, **settings)
