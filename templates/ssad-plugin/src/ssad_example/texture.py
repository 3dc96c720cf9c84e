"""An attack that trains a texture: few epochs, and colours near those of the paint."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ssad.scenarios.static.physical import TextureAttack
from ssad_example.loss import TopScores


def pale(**settings: Any) -> TextureAttack:
    """Return the settings of the training; a suite changes them with `settings: {epochs: 5}`."""
    attack = TextureAttack("example-pale", TopScores(), epochs=10, stealth=0.05)
    return replace(attack, **settings)
