"""Lists of `ssad list`: names that other commands and suites accept, looked up on demand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

from ssad.core.wording import counted


def _scenario_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.scenarios.dynamic import SCENARIOS, load_scenarios, set_names
    from ssad.scenarios.dynamic.sets import SHIPPED

    sets = {name: load_scenarios(name) for name in set_names()}
    rows = {name: f"set of {counted(len(scenarios), 'scenario')}" for name, scenarios in sets.items()}
    counts = Counter(scenario.type for name in SHIPPED for scenario in sets[name])
    for name, origin in names("scenario", SCENARIOS).items():
        rows[name] = (
            f"class with {counted(counts[name], 'scenario')}" if name in SCENARIOS else f"class of your own: {origin}"
        )
    return rows | {
        scenario.name: f"{scenario.type} in {scenario.town}" for scenarios in sets.values() for scenario in scenarios
    }


def _system_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.drivers import SYSTEMS

    rows = names("system", SYSTEMS) | {"ppo:FILE": "PPO with other weights, FILE.safetensors; also sac and td3"}
    return rows | {"module:object": "a driving system of your own (README.md)"}


def _part_list(kind: str) -> dict[str, str]:
    from ssad.drivers.perceiving.parts import part_names

    return part_names(kind) | {"module:object": f"a {kind} of your own (docs/how-to/perceiving-parts.md)"}


def _kind_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.experiments.suites import KINDS

    return names("kind", KINDS) | {"module:class": "a kind of your own (ARCHITECTURE.md)"}


def _town_list() -> dict[str, str]:
    from ssad.world.roads import town_names

    return town_names()


def _suite_list() -> dict[str, str]:
    from ssad.core.safeio import read_yaml_document
    from ssad.experiments.suites import suite_files

    # as plain YAML: the schema of some needs an extra
    return {name: str(read_yaml_document(path).data.get("title", "")) for name, path in suite_files().items()}


def _shift_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.scenarios.static.shifts.spec import EXTRA, KNOWN

    notes_by_shift = dict.fromkeys(EXTRA, " (beside the paper's, only if named)")
    rows = {
        name: f"{family}: {description}{notes_by_shift.get(name, '')}" for name, (family, description) in KNOWN.items()
    }
    return rows | names("shift", {}) | {"module:object": "a shift of your own (docs/reference/perturbations.md)"}


def _perturbation_list() -> dict[str, str]:
    from ssad.scenarios.static.catalogue import registered_names

    rows = dict(sorted(registered_names().items(), key=lambda pair: pair[::-1]))
    return rows | {
        "NAME.json": "texture: the card of a texture, beside NAME.png (docs/reference/physical.md)",
        "FOLDER": "texture or light: what ssad export texture or ssad export light wrote",
        "module:object": "a perturbation of your own (docs/reference/gap.md)",
    }


def _attack_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.scenarios.static.digital import ATTACKS, attack_names, default_loss, make_attack, needs
    from ssad.scenarios.static.physical import default_carrier, physical_names
    from ssad.scenarios.static.physical.lights import LIGHTS

    def describe(name: str, origin: str) -> str:
        if name not in ATTACKS:
            return origin
        if needs(name):
            return f"made in Python: needs {', '.join(needs(name))} (docs/how-to/attack-detectors.md)"
        access = make_attack(name).access
        if name == "universal":
            return f"one change for all images, fitted to other drives, loss {default_loss(name)}"
        return f"{access}, loss {default_loss(name)}" if access != "none" else "random noise of the same size"

    rows = {name: describe(name, origin) for name, origin in attack_names().items()}
    guide = "docs/how-to/paint-a-car.md"
    rows |= {name: f"physical: trains a {default_carrier(name)} ({guide})" for name in physical_names()}
    rows |= dict.fromkeys(LIGHTS, f"physical: light on a target, not on its paint ({guide})")
    rows |= names("light", {})
    return rows | {"module:object": "an attack of your own (docs/how-to/attack-detectors.md)"}


def _generator_list() -> dict[str, str]:
    from ssad.scenarios.dynamic.generate import generator_list

    templates = {
        "scenic:FILE.scenic": "samples of a Scenic program (docs/how-to/import-scenic.md)",
        "module:object": "a generator of your own (docs/how-to/search-for-collisions.md)",
    }
    return generator_list() | templates


def _loss_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.scenarios.static.digital.objectives import LOSSES, OBJECTIVES, TERMS, Objective

    def describe(name: str, origin: str) -> str:
        if name not in LOSSES:
            return origin
        objective: Objective = OBJECTIVES[name]()
        if name == "full" or name in TERMS:
            return "training losses of the detector" + ("" if name == "full" else f": those of {name}")
        return (type(objective).__doc__ or "").strip().partition("\n")[0].rstrip(".")

    rows = {name: describe(name, origin) for name, origin in names("loss", LOSSES).items()}
    return rows | {"module:object": "a loss of your own (docs/how-to/attack-detectors.md)"}


def _defence_list() -> dict[str, str]:
    from ssad.core.registry import names, resolve
    from ssad.scenarios.static.digital.defences import DEFENCES

    rows = {
        name: resolve("defence", DEFENCES, name).__doc__.strip().partition("\n")[0].rstrip(".")
        if name in DEFENCES
        else origin
        for name, origin in names("defence", DEFENCES).items()
    }
    return rows | {"module:object": "a defence of your own (docs/how-to/attack-detectors.md)"}


def _simulator_list() -> dict[str, str]:
    from ssad.core.registry import names
    from ssad.simulators.closed_loop import SIMULATORS

    rows = names("simulator", SIMULATORS) | {"carla://HOST:PORT": "a CARLA server (docs/how-to/use-carla.md)"}
    return rows | {"module:object": "a simulator of your own (docs/how-to/drive-agents.md)"}


def _detector_list() -> dict[str, str]:
    from ssad.detectors import SHIPPED, detector_names

    def describe(name: str, origin: str) -> str:
        if origin.startswith("ssad."):
            kind = "3D" if "fcos3d" in name or "pgd" in name else "2D"
            if not (SHIPPED / f"{name}.json").is_file():
                return f"{kind}, no weights shipped"
            return f"{kind}, weights shipped, which learned from images that SSAD rendered"
        return origin

    rows = {name: describe(name, origin) for name, origin in detector_names().items()}
    rows |= {
        "centernet:FILE": "2D, learned from photographs: npm pack @vladmandic/human (docs/how-to/use-detectors.md)",
        "onnx:FILE": "2D, an exported detector (docs/how-to/use-detectors.md)",
    }
    return rows | {"module:object": "a detector of your own (docs/how-to/use-detectors.md)"}


def _recipe_list() -> dict[str, str]:
    from ssad.training.recipe import RECIPES
    from ssad.training.reinforcement import POLICY_RECIPES

    detectors = {
        name: f"{recipe.detector}: {recipe.epochs} epochs, batch {recipe.batch}, {recipe.optimizer}, lr {recipe.lr:g}"
        for name, recipe in RECIPES.items()
    }
    return detectors | {
        name: f"driver: {recipe.steps:,} steps, lr {recipe.lr:g}" for name, recipe in POLICY_RECIPES.items()
    }


def _dimension_list() -> dict[str, str]:
    from ssad.recorders.randomisation import DIMENSIONS

    return {name: dimension.describe() for name, dimension in DIMENSIONS.items()}


LISTS: Final[Mapping[str, Callable[[], dict[str, str]]]] = {
    "suites": _suite_list,
    "kinds": _kind_list,
    "scenarios": _scenario_list,
    "generators": _generator_list,
    "systems": _system_list,
    "perceivers": partial(_part_list, "perceiver"),
    "trackers": partial(_part_list, "tracker"),
    "planners": partial(_part_list, "planner"),
    "detectors": _detector_list,
    "recipes": _recipe_list,
    "perturbations": _perturbation_list,
    "shifts": _shift_list,
    "attacks": _attack_list,
    "losses": _loss_list,
    "defences": _defence_list,
    "simulators": _simulator_list,
    "towns": _town_list,
    "dimensions": _dimension_list,
}
"""What can be listed -> makes its rows: name, and what it is."""
ALIASES: Final = {"agents": "systems"}
