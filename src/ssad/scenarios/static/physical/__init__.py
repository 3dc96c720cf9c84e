"""Physical adversarial attacks on detectors (paper III.A.1): textures on a driving target.

`train_texture(make_physical("vanishing"), detector, Camouflage().on(mesh), views, start=...)`.
"""

from __future__ import annotations

from ssad.scenarios.static.physical.textures.attacks import ATTACKS, default_carrier, make_physical, physical_names
from ssad.scenarios.static.physical.textures.carrier import Camouflage, Carrier, Patch, TextureSurface, albedo_of
from ssad.scenarios.static.physical.textures.controls import CONTROLS, control
from ssad.scenarios.static.physical.textures.optimise import (
    TextureAttack,
    TextureTrainingResult,
    TextureView,
    train_texture,
)
from ssad.scenarios.static.physical.textures.printing import Expectation
from ssad.scenarios.static.physical.textures.spec import CARRIERS, TextureSpec, make_carrier

__all__ = [
    "ATTACKS",
    "CARRIERS",
    "CONTROLS",
    "Camouflage",
    "Carrier",
    "Expectation",
    "Patch",
    "TextureAttack",
    "TextureSpec",
    "TextureSurface",
    "TextureTrainingResult",
    "TextureView",
    "albedo_of",
    "control",
    "default_carrier",
    "make_carrier",
    "make_physical",
    "physical_names",
    "train_texture",
]
