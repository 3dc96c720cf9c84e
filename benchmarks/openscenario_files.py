"""Import of public OpenSCENARIO files, and how much of each is carried over.

    python -m benchmarks.openscenario_files --page NAME@COMMIT=FOLDER...

Each folder, such as a part of a checkout of a public repository at the commit that its name states, is searched for
`.xosc` files with a storyboard or a distribution of parameters. Towns that the files do not bring are taken from
SSAD_HOME; maps that come with the files are imported to a folder of their own. The files are no part of SSAD.
`--page` writes docs/results/openscenario-imports.md.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.insert import insert, store_commit
from ssad.core.errors import SSADError
from ssad.core.safeio import home_folder
from ssad.interchange.openscenario_document import read_document
from ssad.interchange.openscenario_reader import read_openscenario_set

MOST = 20  # scenarios read of a distribution
SHOWN = 25  # reasons
PAGE = "results/openscenario-imports.md"
# Doubts that leave the motion of actors as it is.
STANDING = re.compile(r"of the stop trigger|no entity is called|^map: ")


@dataclass
class Result:
    """Import of one file.

    Attributes:
        path: The file.
        error: Why it does not import.
        seconds: CPU time, s.
        actors: Number of actors of its first scenario.
        omissions: What is not carried over and leaves motions as they are.
        doubts: What differs from the file.
    """

    path: Path
    error: str = ""
    seconds: float = 0.0
    actors: int = 0
    omissions: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        """Return whether all that moves actors is carried over."""
        return not self.error and all(STANDING.search(reason) for reason in self.doubts)


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
    result.doubts = list(imported.report.doubts)
    return result


def report_lines(folders: dict[str, list[Result]]) -> dict[str, list[str]]:
    """Return the lines of each part of the page on the files of folders, by names such as owner/repository@commit."""
    rows = [
        "| Files of | commit | files | import | share | all motion | actors | longest, s |",
        "|---|---|---:|---:|---:|---:|---:|---:|",
    ]
    errors = []
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
            reasons.update({_general(reason) for reason in result.omissions + result.doubts})
    lines = ["| Reason | files |", "|---|---:|"]
    lines += [f"| {reason} | {count} |" for reason, count in reasons.most_common(SHOWN)]
    return {"files": rows, "errors": errors or ["None."], "reasons": lines}


def _general(reason: str) -> str:
    """Return a reason without the names and numbers of its file."""
    return re.sub(r"(?<![A-Za-z])-?\d+(\.\d+)?", "n", re.sub(r"'[^']*'", "…", reason)).replace("|", "/")


def main() -> None:
    """Import the files of NAME=FOLDER arguments, print, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", metavar="NAME@COMMIT=FOLDER")
    parser.add_argument("--page", action="store_true", help=f"write docs/{PAGE}")
    arguments = parser.parse_args()
    towns = home_folder() / "towns"
    results: dict[str, list[Result]] = {}
    with tempfile.TemporaryDirectory() as home:
        if towns.is_dir():
            shutil.copytree(towns, Path(home) / "towns")
        os.environ["SSAD_HOME"] = home
        for argument in arguments.folders:
            name, _, folder = argument.rpartition("=")
            paths = [path for path in sorted(Path(folder).glob("*.xosc")) if is_scenario(path)]
            name = name or Path(folder).name
            results[name] = []
            for number, path in enumerate(paths, 1):
                results[name].append(check_file(path))
                print(f"{name}: {number} of {len(paths)}", file=sys.stderr)
    parts = report_lines(results)
    print("\n".join(line for lines in parts.values() for line in lines))
    if arguments.page:
        for mark, lines in parts.items():
            insert(PAGE, mark, ["", *lines, ""])
        store_commit(PAGE)


if __name__ == "__main__":
    main()
