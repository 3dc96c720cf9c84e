"""Import of public OpenSCENARIO files, and how much of each is carried over.

    python benchmarks/openscenario_files.py docs/results/openscenario-imports.md NAME@COMMIT=FOLDER...

Each folder, such as a part of a checkout of a public repository at the commit that its name states, is searched for
`.xosc` files with a storyboard or a distribution of parameters. Towns that the files do not bring are taken from
SSAD_HOME; maps that come with the files are imported to a folder of their own. The files are no part of SSAD.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from ssad.core.errors import SSADError
from ssad.core.safeio import home_folder, write_atomic
from ssad.interchange.openscenario_document import read_document
from ssad.interchange.openscenario_reader import read_openscenario_set

MOST = 20  # scenarios read of a distribution
SHOWN = 25  # reasons
PAGE = """# Public OpenSCENARIO files

> **Stored result.** Weights: none. Torch: not used. Make it anew: `python benchmarks/openscenario_files.py OUT.md \
NAME@COMMIT=FOLDER...`, with checkouts of the repositories below.

*Import*: `ssad import openscenario` makes scenarios of the file, and each builds as an episode on its map. *All
motion*: everything that moves an actor is carried over. Weather, lights, variables, what the ego is told to do, and
ends of the episode other than by time and distance do not count; they are listed below. Of a distribution, at most
{most} sets of values are read. Times are CPU seconds of one core, with the import of the map.

| Files of | commit | files | import | share | all motion | actors | longest, s |
|---|---|---:|---:|---:|---:|---:|---:|
{rows}

## Files that do not import
{errors}

## What is not carried over
Files of all folders, by reason.

| Reason | files |
|---|---:|
{reasons}
"""
# What has no part in the motion of actors.
APPEARANCE = re.compile(
    r"EnvironmentAction|LightStateAction|SetAction|VariableCondition|VisibilityAction|ControllerAction|controller"
    r"|of the ego|UserDefinedAction|of the stop trigger|ParameterCondition|no entity is called|AppearanceAction"
)


@dataclass
class Result:
    """Import of one file.

    Attributes:
        path: The file.
        error: Why it does not import.
        seconds: CPU time, s.
        actors: Number of actors of its first scenario.
        omissions: What is not carried over.
    """

    path: Path
    error: str = ""
    seconds: float = 0.0
    actors: int = 0
    omissions: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        """Whether all that moves actors is carried over."""
        return not self.error and all(APPEARANCE.search(reason) for reason in self.omissions)


def is_scenario(path: Path) -> bool:
    """Return whether a file has a storyboard or a distribution; a broken one may have."""
    try:
        root = read_document(path)
    except SSADError:
        return True
    return root.find("Storyboard") is not None or root.find("ParameterValueDistribution") is not None


def check_file(path: Path) -> Result:
    """Import a file."""
    result = Result(path)
    started = time.process_time()
    try:
        imported = read_openscenario_set(path, count=MOST)
    except SSADError as error:
        result.error = str(error).replace(f"{path.parent}/", "")
        return result
    result.seconds = time.process_time() - started
    result.actors = len(imported.scenarios[0].actors)
    result.omissions = list(imported.report.omissions)
    return result


def page(folders: dict[str, list[Result]]) -> str:
    """Return the page on the files of folders, by names such as owner/repository@commit."""
    rows, errors = [], []
    reasons: Counter[str] = Counter()
    for name, results in folders.items():
        good = [result for result in results if not result.error]
        repository, _, commit = name.partition("@")
        cells = (
            repository,
            commit[:10],
            str(len(results)),
            str(len(good)),
            f"{100 * len(good) / max(len(results), 1):.1f} %",
            str(sum(result.is_whole for result in results)),
            str(sum(result.actors for result in good)),
            f"{max((result.seconds for result in good), default=0.0):.1f}",
        )
        rows.append(f"| {' | '.join(cells)} |")
        errors += [f"* {repository}: {result.error}" for result in results if result.error]
        for result in good:
            reasons.update({_general(reason) for reason in result.omissions})
    lines = [f"| {reason} | {count} |" for reason, count in reasons.most_common(SHOWN)]
    return PAGE.format(most=MOST, rows="\n".join(rows), errors="\n".join(errors) or "None.", reasons="\n".join(lines))


def _general(reason: str) -> str:
    """Return a reason without the names and numbers of its file."""
    return re.sub(r"(?<![A-Za-z])-?\d+(\.\d+)?", "n", re.sub(r"'[^']*'", "…", reason)).replace("|", "/")


def main(out: str, *folders: str) -> None:
    """Import the files of NAME=FOLDER arguments and write the page."""
    towns = home_folder() / "towns"
    results: dict[str, list[Result]] = {}
    with tempfile.TemporaryDirectory() as home:
        if towns.is_dir():
            shutil.copytree(towns, Path(home) / "towns")
        os.environ["SSAD_HOME"] = home
        for argument in folders:
            name, _, folder = argument.rpartition("=")
            paths = [path for path in sorted(Path(folder).glob("*.xosc")) if is_scenario(path)]
            name = name or Path(folder).name
            results[name] = []
            for number, path in enumerate(paths, 1):
                results[name].append(check_file(path))
                print(f"{name}: {number} of {len(paths)}", file=sys.stderr)
    write_atomic(Path(out), page(results))


if __name__ == "__main__":
    main(*sys.argv[1:])
