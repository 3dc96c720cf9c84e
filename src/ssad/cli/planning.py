"""`ssad plan`: the cells of a suite, and the cases that a difference needs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ssad.cli import paths
from ssad.cli.options import Device
from ssad.core.errors import ConfigError


def plan(
    suite: Annotated[
        str, typer.Argument(metavar="SUITE", help="Name of a suite (see: ssad list suites) or YAML file.")
    ],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Override a key of the suite; can be repeated."),
    ] = None,
    detect: Annotated[
        float | None,
        typer.Option(
            metavar="DIFFERENCE", min=0.001, max=0.99, help="Say how many cases a difference of two rates needs."
        ),
    ] = None,
    power: Annotated[
        float, typer.Option(min=0.5, max=0.99, help="Probability that such a difference is detected.")
    ] = 0.8,
    runs: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FOLDER",
            help="Run whose flip rates are used; can be repeated.  [default: those of shipped systems]",
        ),
    ] = None,
    device: Device = "auto",
) -> None:
    """Say what a suite would run, and how many cases a difference needs; nothing is run or written.

    A difference is detected if its 95 % interval leaves out 0 (docs/explanation/intervals.md). Which number of cases
    that needs depends on the flip rate, the share of the cases in which one of two systems has the event, and on how
    alike the cases of a cluster are. Both are measured, in runs of your own or in those of the shipped systems.
    """
    paths.check_exists(*(runs or []))
    paths.check_named_files(suite, settings or [])
    from ssad.cli.forecast import forecast
    from ssad.engine.kind import Resources
    from ssad.experiments.sample_size import check_rates, detection_lines, sample_line
    from ssad.experiments.suites import load_suite
    from ssad.results import make_plan

    if runs and detect is None:
        raise ConfigError("--runs can only be used with --detect")
    if detect is not None:
        check_rates(load_suite(suite, settings or []))
    cell_plan = make_plan(suite, settings or [], device=device)
    lines = forecast(cell_plan, Path("runs") / cell_plan.suite.name, Resources(device=cell_plan.device))
    if cell_plan.kind.rates:
        lines.append(sample_line(cell_plan))
    if detect is not None:
        lines += ["", *detection_lines(cell_plan, detect, target=power, folders=runs or [])]
    for line in lines:
        print(line)
