"""Digital adversarial attacks on detectors (paper III.A.1), each under an exact budget on 8-bit pictures.

`run_attack(make_attack("pgd"), detector, images, truth, Budget(px(5)))`; which loss is ascended is an attack's own
choice unless it is told another.
"""

from __future__ import annotations

from typing import Any

from ssad.core.registry import names, resolve
from ssad.scenarios.static.digital.attack import Attack, Attacked, run_attack
from ssad.scenarios.static.digital.budget import Budget, px
from ssad.scenarios.static.digital.objectives import OBJECTIVES, Aim, Objective, make_objective

_HERE = "ssad.scenarios.static.digital"
ATTACKS: dict[str, str] = {
    "fgsm": f"{_HERE}.fgsm:FGSM",
    "pgd": f"{_HERE}.pgd:PGD",
    "cw": f"{_HERE}.cw:cw",
    "momentum": f"{_HERE}.momentum:momentum",
    "apgd": f"{_HERE}.apgd:APGD",
    "cw-min": f"{_HERE}.cw:MinimalCW",
    "square": f"{_HERE}.square:Square",
    "nes": f"{_HERE}.nes:NES",
    "spsa": f"{_HERE}.nes:spsa",
    "transfer": f"{_HERE}.transfer:Transfer",
    "universal": f"{_HERE}.universal:Universal",
    "expected": f"{_HERE}.expectation:Expected",
    "noise": f"{_HERE}.noise:RandomNoise",
}
LOSS: dict[str, str] = {"cw": "margin", "cw-min": "margin"}
"""The loss that an attack is about; all others ascend the full training loss unless they are told another."""


def attack_names() -> dict[str, str]:
    """All names -> where they come from."""
    return names("attack", ATTACKS)


def make_attack(name: str, **options: Any) -> Any:
    """An attack by name.

    Args:
        name: Of `ATTACKS`, one that a package offers (`ssad.attacks`), or "module:object".
        **options: What its constructor takes.

    Raises:
        UnknownNameError: There is no such attack.
        ConfigError: An option that it does not have, or a value that it refuses.
    """
    from ssad.core.errors import ConfigError

    build = resolve("attack", ATTACKS, name)
    if not callable(build):
        return build
    try:
        return build(**options)
    except TypeError as error:
        raise ConfigError(f"attack {name}: {error}") from None


def default_loss(name: str) -> str:
    """The loss that an attack ascends if it is told none."""
    return LOSS.get(name, "full")


__all__ = [
    "ATTACKS",
    "OBJECTIVES",
    "Aim",
    "Attack",
    "Attacked",
    "Budget",
    "Objective",
    "attack_names",
    "default_loss",
    "make_attack",
    "make_objective",
    "px",
    "run_attack",
]
