"""Named effects of the rendering, each of which can be switched on and off.

    quality = RenderQuality(effects=select_effects("reflections", "haze"))
    render(scene, views, quality=quality)

Pictures without an effect are the same, bit by bit, as if the effect did not exist.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from ssad.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Effect:
    """Effect of the rendering.

    Attributes:
        name: Name in `RenderQuality.effects`.
        summary: Sentence that says what it adds to a picture.
        is_default: Whether it is on unless a caller names other effects.
    """

    name: str
    summary: str
    is_default: bool = True


EFFECTS: Final[dict[str, Effect]] = {
    effect.name: effect
    for effect in (
        Effect("reflections", "Glass, paint and metal mirror the sky, the buildings and the trees around the camera."),
        Effect("wet-reflections", "Wet roads mirror what stands on them."),
        Effect("soft-shadows", "The penumbra of the sun grows with the distance of what casts the shadow."),
        Effect("lit-signals", "Traffic lights show their state."),
        Effect("walker-signals", "Signals for walkers stand at crossings whose traffic has signals."),
        Effect("vehicle-signals", "Stop lamps and indicators of vehicles shine."),
        Effect("street-lighting", "Streets at night have the light of a class of EN 13201."),
        Effect("low-beams", "The head lamps of vehicles have the pattern of a low beam, with a cut-off."),
        Effect("haze", "Distant surfaces fade into the light of the horizon in clear weather too."),
        Effect("bloom", "The lens scatters light, so that the sun and lamps glow and veil what is near them."),
        Effect("flare", "Bright lights have ghosts, which reflections between the surfaces of the lens make."),
    )
}

ALL_EFFECTS: Final = frozenset(EFFECTS)
DEFAULT_EFFECTS: Final = frozenset(effect.name for effect in EFFECTS.values() if effect.is_default)
NO_EFFECTS: Final[frozenset[str]] = frozenset()
SETS: Final = {"all": ALL_EFFECTS, "default": DEFAULT_EFFECTS, "none": NO_EFFECTS}


def select_effects(*names: str) -> frozenset[str]:
    """Return a set of effects.

    Args:
        names: Names of effects. `all` stands for all of them, `default` for those that are on by default, and
            `none` for none of them, as does no name.

    Raises:
        ConfigError: An effect is unknown.
    """
    effects: frozenset[str] = frozenset()
    for name in names:
        effects |= SETS.get(name, frozenset({name}))
    check_effects(effects)
    return effects


def check_effects(effects: frozenset[str]) -> None:
    """Check that all names are those of effects.

    Raises:
        ConfigError: An effect is unknown.
    """
    for name in sorted(effects - ALL_EFFECTS):
        raise ConfigError(f"unknown effect of the rendering {name!r}; there are {', '.join(sorted(EFFECTS))}")
