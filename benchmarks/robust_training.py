"""Adversarial training against a control that continues from the same weights for as many steps without attacks.

    python -m benchmarks.robust_training fcos3d-light --data DRIVES --weights W.safetensors --out DIR --device cuda
    python -m benchmarks.robust_training --out DIR --page        # docs/results/robust-training.md

Both arms have one recipe, one seed, the same images in the same order and the same number of steps; they differ in
`radius` and `attack_steps` alone, so no difference comes from more training, other data or an older start. The suite
`digital` attacks each of them by itself. A stopped run continues when it is started again.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from ssad.core import safeio
from ssad.core.checkpoints import WeightsCard, read_card
from ssad.core.errors import ConfigError
from ssad.experiments.perception.digital.run import DigitalRun, load_digital_run
from ssad.experiments.perception.digital.tables import hardened_table
from ssad.experiments.suites import load_suite
from ssad.report.load import load_run
from ssad.report.tables import to_markdown
from ssad.training.detector import DetectorPlan, parse_changes, run_training

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "results" / "robust-training.md"
CONTROL, ROBUST = "control", "robust"
ATTACK_KEYS = ("radius", "attack_steps")
SUITE = (
    "attacks=[{name: fgsm, loss: full}, {name: pgd, loss: full}, {name: cw, loss: margin}, {name: pgd, loss: margin}]",
    "sweeps=[{name: pgd, loss: margin, scenes: 2, radii: [0, 1, 2, 5]}]",
    "transfer=[]",
    "transfer_detectors=[]",
)


def arms(recipe: str, data: Path, weights: Path, out: Path, *, settings: list[str], device: str) -> list[DetectorPlan]:
    """Return the plans of both arms; the control is the recipe without attacks.

    Raises:
        ConfigError: The settings have no radius above 0.
    """
    changes = dict(parse_changes(settings))
    if not changes.get("radius", 0.0) > 0.0:
        raise ConfigError("name the radius of the attacks of the training: --set radius=2")
    plain = {key: value for key, value in changes.items() if key not in ATTACK_KEYS}
    return [
        DetectorPlan(recipe, (data,), out / arm, changes=tuple(values.items()), weights=weights, device=device)
        for arm, values in ((CONTROL, plain), (ROBUST, changes))
    ]


def check_fairness(control: WeightsCard, robust: WeightsCard) -> dict[str, Any]:
    """Return the settings that both trainings share, and the radius.

    Raises:
        ConfigError: They differ in anything but the attacks, or one of them started at random.
    """
    keys = sorted((set(control.config) | set(robust.config)) - set(ATTACK_KEYS))
    different = [key for key in keys if control.config.get(key) != robust.config.get(key)]
    different += [name for name in ("data", "seed", "classes") if getattr(control, name) != getattr(robust, name)]
    if different:
        raise ConfigError(f"the arms differ in {', '.join(different)}; train them anew, with one command")
    if "first_weights" not in control.config:
        raise ConfigError("the arms started from random weights; name initial weights with --weights")
    if control.config.get("radius") or not robust.config.get("radius"):
        raise ConfigError("the control needs a training without attacks, the other arm one with them; train them anew")
    shared = {key: control.config[key] for key in ("epochs_done", "batch", "lr")}
    return shared | {"first_weights": control.config["first_weights"], "radius": robust.config["radius"]}


def attack(recipe: str, out: Path, device: str, settings: list[str]) -> None:
    """Attack both arms by the suite `digital`; OUT/attacks is its results folder."""
    detectors = [f"{arm}={out / arm / f'{recipe}.safetensors'}" for arm in (CONTROL, ROBUST)]
    overrides = [f"detectors=[{recipe}@{detectors[0]}]", f"hardened=[{recipe}@{detectors[1]}]", *SUITE, *settings]
    command = [sys.executable, "-m", "ssad", "run", "digital", "--out", str(out / "attacks"), "--device", device]
    subprocess.run([*command, *(part for setting in overrides for part in ("--set", setting))], check=True)


def page(out: Path) -> str:
    """Return the page of a finished comparison."""
    recipe = next((out / CONTROL).glob("*.safetensors")).stem
    control, robust = (read_card(out / arm / f"{recipe}.safetensors") for arm in (CONTROL, ROBUST))
    return page_text(control, robust, load_digital_run(load_run(out / "attacks")))


def page_text(control: WeightsCard, robust: WeightsCard, run: DigitalRun) -> str:
    """Return the page: the settings that the arms share, and the table of both."""
    shared = check_fairness(control, robust)
    first = shared["first_weights"]
    origin = f"`{first['file']}`" + (f" ({first['hash'][:12]})" if "hash" in first else "")
    lines = [
        "# Adversarial training, compared fairly",
        "",
        f"Both arms continued from {origin} for {shared['epochs_done']} epochs of the same images in the same order "
        f"(batch {shared['batch']}, learning rate {shared['lr']:g}). One of them attacked each image within "
        f"{shared['radius']:g} code values before it learned from it; the control, which is the ordinary one of the "
        "table, did not. Nothing else differs between them.",
        "",
        f"Commands: `{control.command}`, `{robust.command}`, `{run.run.command}`.",
        "",
        to_markdown(hardened_table(run)).strip(),
        "",
    ]
    return "\n".join(lines)


def main() -> None:
    """Train what is missing, attack it, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", nargs="?", default="fcos3d-light")
    parser.add_argument("--data", type=Path, help="recorded drives, with the splits train and val")
    parser.add_argument("--weights", type=Path, help="initial weights of both arms")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--set", action="append", default=[], dest="settings", help="values of the recipe of both arms")
    parser.add_argument("--suite", action="append", default=[], help="keys of the suite digital")
    parser.add_argument("--page", action="store_true")
    options = parser.parse_args()
    if options.page:
        safeio.write_atomic(DOCUMENT, page(options.out))
        return
    if options.data is None or options.weights is None:
        parser.error("--data and --weights are needed to train")
    # Wrong keys should fail before hours of training.
    load_suite("digital", (*SUITE, *options.suite))
    for plan in arms(
        options.recipe, options.data, options.weights, options.out, settings=options.settings, device=options.device
    ):
        for line in run_training(plan):
            print(line, flush=True)
    check_fairness(*(read_card(options.out / arm / f"{options.recipe}.safetensors") for arm in (CONTROL, ROBUST)))
    attack(options.recipe, options.out, "cpu" if options.device == "auto" else options.device, options.suite)
    print(page(options.out))


if __name__ == "__main__":
    main()
