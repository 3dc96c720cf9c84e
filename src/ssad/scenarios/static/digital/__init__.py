"""Digital adversarial attacks on detectors (paper III.A.1), each under an exact budget on 8-bit pictures.

`run_attack(make_attack("pgd"), detector, images, truth, Budget(px(5)))`; which loss is ascended is an attack's own
choice unless it is told another.
"""

from __future__ import annotations

import inspect
from typing import Any

from ssad.core.errors import ConfigError
from ssad.core.registry import make, names, resolve
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
    "universal": f"{_HERE}.universal:UniversalFit",
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
    build = resolve("attack", ATTACKS, name)
    needed = ("name", "access", "perturb")
    if not callable(build):
        return make("attack", name, build, {}, needed)
    known = inspect.signature(build).parameters
    open_ended = any(one.kind is one.VAR_KEYWORD for one in known.values())
    for option in options:
        if option not in known and not open_ended:
            own = ", ".join(one for one in known if one not in ("name", "access")) or "none"
            raise ConfigError(
                f"attack {name}: there is no option '{option}'; {f'it has {own}' if own else 'it has none'}"
            )
    missing = [option for option in needs(name) if option not in options]
    if missing:
        raise ConfigError(f"attack {name}: it needs {' and '.join(missing)}: make it in Python (docs/attacks.md)")
    return make("attack", name, build, options, needed)


def needs(name: str) -> tuple[str, ...]:
    """Options without which an attack cannot be made; a suite cannot run an attack that has any.

    Args:
        name: As for `make_attack`.
    """
    build = resolve("attack", ATTACKS, name)
    if not callable(build):
        return ()
    positional = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    parameters = inspect.signature(build).parameters.items()
    return tuple(option for option, one in parameters if one.default is one.empty and one.kind in positional)


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
    "needs",
    "px",
    "run_attack",
]
