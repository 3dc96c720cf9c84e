"""`ssad train`: one short function per command. Heavy imports are local, so --help is fast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ssad.cli import paths

Device = Annotated[str, typer.Option(help="Where to compute: auto, cpu or cuda.")]
Changes = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Override a value of the recipe, such as lr=1e-4."),
]

train_app = typer.Typer(no_args_is_help=True, help="Train a detector, a driver or an adversary.")


@train_app.command("detector")
def train_detector(
    recipe: Annotated[str, typer.Argument(metavar="RECIPE", help="Name of a recipe (see: ssad list recipes).")],
    data: Annotated[
        Path,
        typer.Option(
            help=(
                "3D: dataset in the nuScenes schema. 2D: folder that `ssad record --clips` wrote, or photographs of "
                "COCO, KITTI, nuScenes or BDD100K."
            )
        ),
    ],
    more: Annotated[list[Path] | None, typer.Option(help="Another such folder; can be repeated.")] = None,
    val_data: Annotated[
        Path | None, typer.Option(help="3D only: dataset to validate on.  [default: that of --data]")
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder; repeat the command to resume.")] = Path("training"),
    split: Annotated[str, typer.Option(help="Split to train on.")] = "train",
    val: Annotated[str, typer.Option(help="Split to validate on.")] = "val",
    change: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a value of the recipe, such as epochs=3."),
    ] = None,
    weights: Annotated[Path | None, typer.Option(help="Initial weights.")] = None,
    device: Device = "auto",
    gpus: Annotated[int, typer.Option(min=1, help="Number of GPUs, one process each.")] = 1,
    seconds: Annotated[
        float | None, typer.Option(min=0.0, help="Time limit; stops at the end of the epoch that exceeds it.")
    ] = None,
) -> None:
    """Train a detector and validate it on the split val. To resume, repeat the command."""
    paths.check_exists(data, *(more or []), val_data, weights)
    paths.check_out(out, paths.TRAINING)
    from ssad.training.detector import DetectorPlan, parse_changes, run_training

    plan = DetectorPlan(
        recipe,
        (data, *(more or [])),
        out,
        split,
        val,
        parse_changes(change or []),
        weights=weights,
        device=device,
        gpus=gpus,
        seconds=seconds,
        val_data=val_data,
    )
    for line in run_training(plan, report=lambda text: print(text, flush=True)):
        print(line)


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


@train_app.command("driver")
def train_driver(
    algorithm: Annotated[str, typer.Argument(metavar="ALGORITHM", help="ppo, sac or td3.")],
    scenarios: Annotated[
        str, typer.Option(help="Comma-separated sets, classes or files to learn from (see: ssad list scenarios).")
    ] = "training",
    test: Annotated[str, typer.Option(help="Sets that the weights are measured on in the end.")] = "precrash,natural",
    out: Annotated[Path, typer.Option(help="Output folder; repeat the command to resume.")] = Path("training"),
    change: Changes = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Time limit, s; repeat the command to resume.")] = None,
    device: Annotated[str, typer.Option(help="Where the networks are trained: cpu or cuda.")] = "cpu",
    start: Annotated[
        Path | None, typer.Option(help="Folder of an earlier training, whose networks are trained further.")
    ] = None,
) -> None:
    """Train a driving system by reinforcement learning (needs the extra train). To resume, repeat the command."""
    paths.check_exists(start)
    paths.check_out(out, paths.TRAINING)
    from ssad.training.detector import parse_changes
    from ssad.training.driver import DriverPlan, run_driver_training

    plan = DriverPlan(
        algorithm,
        out,
        _names(scenarios),
        _names(test),
        parse_changes(change or []),
        seconds=seconds,
        device=device,
        start=start,
    )
    for line in run_driver_training(plan, report=lambda text: print(text, flush=True)):
        print(line)


@train_app.command("adversary")
def train_adversary(
    algorithm: Annotated[
        str, typer.Argument(metavar="ALGORITHM", help="adv-ppo, adv-ppo-paper, frea, adv-sac, adv-ddpg or adv-dqn.")
    ] = "adv-ppo",
    ego: Annotated[str, typer.Option(help="Driving system that it is trained against.")] = "autopilot",
    scenarios: Annotated[
        str,
        typer.Option(help="Comma-separated sets or files with background traffic.  [default: training,training-lanes]"),
    ] = "",
    test: Annotated[str, typer.Option(help="Sets that the weights are measured on in the end.")] = "natural",
    literal: Annotated[bool, typer.Option("--literal", help="Reward as equation 6 of the paper prints it.")] = False,
    off_road: Annotated[
        float | None,
        typer.Option(min=0.0, help="What a step off the road costs.  [default: 0.5; for adv-ppo-paper 0]"),
    ] = None,
    out: Annotated[Path, typer.Option(help="Output folder; repeat the command to resume.")] = Path("training"),
    change: Changes = None,
    seconds: Annotated[float | None, typer.Option(min=0.0, help="Time limit, s; repeat the command to resume.")] = None,
    region: Annotated[
        Path | None,
        typer.Option(help="Weights of a feasible region as a second critic.  [default: for frea the shipped one]"),
    ] = None,
    device: Annotated[str, typer.Option(help="Where the networks are trained: cpu or cuda.")] = "cpu",
) -> None:
    """Train an adversary against a driving system (needs the extra train). To resume, repeat the command."""
    paths.check_exists(region)
    paths.check_out(out, paths.TRAINING)
    from ssad.training.adversary import AdversaryPlan, run_adversary_training
    from ssad.training.detector import parse_changes

    plan = AdversaryPlan(
        algorithm,
        out,
        ego,
        _names(scenarios),
        _names(test),
        literal,
        off_road,
        parse_changes(change or []),
        seconds,
        region,
        device,
    )
    for line in run_adversary_training(plan, report=lambda text: print(text, flush=True)):
        print(line)


@train_app.command("feasible-region")
def train_feasible_region(
    scenarios: Annotated[
        str, typer.Option(help="Comma-separated sets or files with background traffic to record drives in.")
    ] = "training,training-lanes",
    egos: Annotated[
        str, typer.Option(help="Comma-separated driving systems of the ego, used in turn.")
    ] = "autopilot,ppo",
    adversaries: Annotated[
        str, typer.Option(help="Comma-separated shipped adversaries, used in turn; none: natural traffic.")
    ] = "adv-ppo-paper,adv-ddpg,none",
    out: Annotated[Path, typer.Option(help="Output folder.")] = Path("training"),
    change: Changes = None,
    device: Annotated[str, typer.Option(help="Where the networks are trained: cpu or cuda.")] = "cpu",
) -> None:
    """Learn the feasible region offline: the states in which the ego can still avoid a collision."""
    paths.check_out(out, paths.TRAINING)
    from ssad.training.detector import parse_changes
    from ssad.training.feasibility import RegionPlan, run_region_training

    plan = RegionPlan(
        out,
        _names(scenarios),
        _names(egos),
        _names(adversaries),
        parse_changes(change or []),
        device,
    )
    for line in run_region_training(plan, report=lambda text: print(text, flush=True)):
        print(line)
