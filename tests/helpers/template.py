"""The package of `templates/ssad-plugin`, installed for a test as pip would do it."""

from __future__ import annotations

import shutil
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "templates" / "ssad-plugin"
PROJECT: dict[str, Any] = tomllib.loads((FOLDER / "pyproject.toml").read_text())["project"]
PACKAGE = "ssad_example"


@contextmanager
def installed_template(site: Path, *, copy: bool = False) -> Iterator[Path]:
    """Put the package on the path with the entry points of its pyproject.toml: no build, no network.

    Args:
        site: Empty folder for the metadata, and for a copy of the package.
        copy: Whether the package is copied there, so that a test may edit it.

    Yields:
        The folder of the modules.
    """
    info = site / f"{PACKAGE}-{PROJECT['version']}.dist-info"
    info.mkdir(parents=True)
    groups = PROJECT["entry-points"]
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PROJECT['name']}\nVersion: {PROJECT['version']}\n")
    (info / "entry_points.txt").write_text(
        "\n".join(f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in names.items()) for group, names in groups.items())
    )
    source = FOLDER / "src"
    if copy:
        shutil.copytree(source / PACKAGE, site / PACKAGE, ignore=shutil.ignore_patterns("__pycache__"))
        source = site
    with pytest.MonkeyPatch.context() as patch:
        for folder in dict.fromkeys((site, source)):
            patch.syspath_prepend(folder)
        yield source / PACKAGE
    for name in [name for name in sys.modules if name.partition(".")[0] == PACKAGE]:
        del sys.modules[name]
