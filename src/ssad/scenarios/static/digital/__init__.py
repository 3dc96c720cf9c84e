"""Digital adversarial attacks on detectors (paper III.A.1), each under an exact budget on 8-bit images.

`run_attack(make_attack("pgd"), detector, images, truth, Budget(px(5)))`. Each attack has a default loss
(`default_loss`), which `objective` overrides.
"""

from __future__ import annotations

import inspect
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.registry import make, names, resolve
from ssad.scenarios.static.digital.attack import Attack, AttackResult, run_attack
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.objectives import OBJECTIVES, Aim, Objective, make_objective

_HERE = "ssad.scenarios.static.digital"
ATTACKS: dict[str, str] = {
    "fgsm": f"{_HERE}.fgsm:FGSM",
    "pgd": f"{_HERE}.pgd:PGD",
    "cw": f"{_HERE}.cw:cw",
    "momentum": f"{_HERE}.momentum:momentum",
    "apgd": f"{_HERE}.apgd:apgd",
    "cw-min": f"{_HERE}.cw:MinimalCW",
    "square": f"{_HERE}.square:Square",
    "nes": f"{_HERE}.nes:NES",
    "spsa": f"{_HERE}.nes:spsa",
    "transfer": f"{_HERE}.transfer:Transfer",
    "universal": f"{_HERE}.universal:UniversalFit",
    "expected": f"{_HERE}.expectation:Expected",
    "noise": f"{_HERE}.noise:RandomNoise",
}
LOSS: dict[str, str] = {"cw": "margin", "cw-min": "margin"}
"""The loss that an attack is about; all others ascend the full training loss unless they are told another."""


def attack_names() -> dict[str, str]:
    """Return the names of all attacks and the modules that define them."""
    return names("attack", ATTACKS)


def make_attack(name: str, **options: Any) -> Any:
    """Create an attack by name.

    Args:
        name: Key of `ATTACKS`, entry point of the group `ssad.attacks`, or "module:object".
        **options: Arguments of the attack's constructor.

    Raises:
        UnknownNameError: There is no such attack.
        ConfigError: An option is unknown, missing, or has an invalid value.
    """
    factory = resolve("attack", ATTACKS, name)
    required_attributes = ("name", "access", "perturb")
    if not callable(factory):
        return make("attack", name, factory, {}, required_attributes)
    # Options are checked before the call, so that the error can list the valid ones.
    options_by_name = inspect.signature(factory).parameters
    accepts_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in options_by_name.values())
    for option in options:
        if option not in options_by_name and not accepts_any:
            allowed = (
                ", ".join(parameter for parameter in options_by_name if parameter not in ("name", "access")) or "none"
            )
            raise ConfigError(
                f"attack {name}: there is no option '{option}'; {f'it has {allowed}' if allowed else 'it has none'}"
            )
    missing = [option for option in needs(name) if option not in options]
    if missing:
        raise ConfigError(
            f"attack {name}: it needs {' and '.join(missing)}: make it in Python (docs/how-to/attack-detectors.md)"
        )
    return make("attack", name, factory, options, required_attributes)


def needs(name: str) -> tuple[str, ...]:
    """Return the required options of an attack; a suite can only run attacks without any.

    Args:
        name: As for `make_attack`.
    """
    factory = resolve("attack", ATTACKS, name)
    if not callable(factory):
        return ()
    named_kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = inspect.signature(factory).parameters.items()
    return tuple(
        option
        for option, parameter in parameters
        if parameter.default is parameter.empty and parameter.kind in named_kinds
    )


def default_loss(name: str) -> str:
    """Return the loss that an attack ascends unless another one is given."""
    return LOSS.get(name, "full")


__all__ = [
    "ATTACKS",
    "OBJECTIVES",
    "Aim",
    "Attack",
    "AttackResult",
    "Budget",
    "Objective",
    "attack_names",
    "default_loss",
    "make_attack",
    "make_objective",
    "needs",
    "px",
    "run_attack",
]
