"""Arguments and options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Dir = Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of `ssad run`.")]
Device = Annotated[str, typer.Option(help="Where to compute: auto, cpu or cuda.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Number of worker processes.  [default: one per core]")]
Ray = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Run on the Ray cluster at ADDRESS; 'local' starts one here.")
]
