"""The tests of extras that exclude each other, each in an environment of its own.

    python -m benchmarks.extras [NAME ...] [--run-slow]

Without names all of them. An environment is made by uv from the lock file, in `SSAD_HOME` or ~/.local/share/ssad, and
kept. The exit code is 0 if all tests passed and none was skipped for want of its extra.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from ssad.core.safeio import home_folder

ROOT = Path(__file__).resolve().parent.parent


@dataclass(frozen=True)
class Environment:
    """What is installed (arguments of uv sync) and which tests run in it (arguments of pytest)."""

    install: tuple[str, ...]
    tests: tuple[str, ...]


COMMONROAD = "tests/interchange/test_commonroad_writer_tools.py"
COMMONROAD_FILES = "tests/interchange/test_commonroad_other.py"
ENVIRONMENTS = {
    "commonroad": Environment(
        ("--extra", "commonroad"), (COMMONROAD, COMMONROAD_FILES, "-k", "valid or overlap or protobuf or 2018")
    ),
    "crime": Environment(("--group", "crime"), (COMMONROAD, "-k", "crime")),
    "scenic": Environment(("--extra", "scenic"), ("tests/interchange/test_scenic.py",)),
}
ALONE = ("asam-qc-openscenarioxml", "asam-qc-opendrive")
"""Programs that ask for other versions of what SSAD itself needs: they run beside it, on the path of its tests."""


def _environment(name: str) -> dict[str, str]:
    return os.environ | {
        "UV_PROJECT_ENVIRONMENT": str(home_folder() / "environments" / name),
        "PYTHONPATH": str(ROOT / "src"),
    }


def _run(name: str, more: list[str]) -> int:
    """Install and test; gives the exit code of pytest, or 1 if a test was skipped for want of something."""
    told = ENVIRONMENTS[name]
    variables = _environment(name)
    subprocess.run(
        ["uv", "sync", "--quiet", "--frozen", "--group", "dev", *told.install], cwd=ROOT, env=variables, check=True
    )
    python = Path(variables["UV_PROJECT_ENVIRONMENT"]) / "bin" / "python"
    command = [str(python), "-m", "pytest", "-q", *told.tests, *more]
    done = subprocess.run(command, cwd=ROOT, env=variables, check=False, capture_output=True, text=True)
    print(done.stdout, done.stderr, sep="", end="")
    return done.returncode or int("is not installed" in done.stdout or "could not import" in done.stdout)


def _asam(more: list[str]) -> int:
    """The checkers of ASAM on the path of this environment's tests."""
    folder = home_folder() / "environments" / "asam"
    subprocess.run(["uv", "venv", "--quiet", "--allow-existing", "--python", "3.11", folder], check=True)
    subprocess.run(
        ["uv", "pip", "install", "--quiet", *ALONE], env=os.environ | {"VIRTUAL_ENV": str(folder)}, check=True
    )
    path = os.pathsep.join([str(folder / "bin"), os.environ.get("PATH", "")])
    command = [sys.executable, "-m", "pytest", "-q", "tests/interchange/test_openscenario.py", "-k", "asam", *more]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"PATH": path}, check=False, capture_output=True, text=True
    )
    print(done.stdout, done.stderr, sep="", end="")
    return done.returncode or int("no qc_" in done.stdout)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(ENVIRONMENTS)}, asam")
    parser.add_argument("--run-slow", action="store_true", help="slow tests too")
    given = parser.parse_args()
    names = given.names or [*ENVIRONMENTS, "asam"]
    if unknown := set(names) - {*ENVIRONMENTS, "asam"}:
        parser.error(f"no such environment: {', '.join(sorted(unknown))}")
    more = ["--run-slow"] if given.run_slow else []
    failed = []
    for name in names:
        print(f"== {name}", flush=True)
        if _asam(more) if name == "asam" else _run(name, more):
            failed.append(name)
    print(f"failed: {', '.join(failed)}" if failed else f"passed: {', '.join(names)}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
