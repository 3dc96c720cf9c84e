"""What works without the extra `perception`, and what everything else says: torch cannot be imported."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ssad.core import errors
from tests.cli.test_shift import perfect

ABSENT = "raise ModuleNotFoundError(f'No module named {__name__!r}', name=__name__)\n"
# modules that nothing but perception, learning and gradients may need; whatever is not under them imports without torch
NEEDS = (
    "core.checkpoints",
    "core.eval_mode",
    "core.pickled",
    "core.tensor_boxes",
    "detectors.",
    "drivers.learned",
    "drivers.perceiving",
    "experiments.driving.attacked_film",
    "experiments.gap.",
    "experiments.perception.",
    "metrics.target_",
    "rendering.camera.texture",
    "rendering.camera.torch_",
    "scenarios.dynamic.logged.near_miss",
    "scenarios.dynamic.policy",
    "scenarios.dynamic.transition",
    "scenarios.static.digital",
    "scenarios.static.physical",
    "training.",
    "world.policy",
    "world.sb3",
    "world.twin",
)
FREE = (
    "cli",
    "cli.doctor",
    "cli.listing",
    "envs",
    "results",
    "datasets.browse",
    "datasets.nuscenes.score",
    "drivers.careful.grade",
    "experiments.adversarial.kind",
    "experiments.adversarial.search_scores",
    "experiments.driving.kind",
    "experiments.driving.run_images",
    "experiments.how_often.failure_rate",
    "experiments.how_often.kind",
    "experiments.tour.kind",
    "interchange.export",
    "recorders.drives",
    "recorders.shifted.write",
    "recorders.target_recording",
    "report.compare",
    "scenarios.dynamic.generate",
    "scenarios.static.shifts",
    "simulators.closed_loop",
    "world.env",
    "world.rollout",
)
WALK = """
import importlib, json, pkgutil, ssad
from ssad.core.errors import EXTRA_OF
failed = []
for module in pkgutil.walk_packages(ssad.__path__, "ssad.", onerror=lambda name: None):
    if module.name == "ssad.__main__":
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        root = error.name.partition(".")[0]
        assert root in EXTRA_OF, (module.name, error)
        if root in ("torch", "torchvision"):  # another extra may be absent here
            failed.append(module.name)
print(json.dumps(failed))
"""
DEEDS = (
    f"""
FREE = {FREE}
"""
    + """
import importlib
import sys
from pathlib import Path
import ssad
from helpers.command import ssad as command

def told(*words):
    done = command(*words)
    print(done.returncode, (done.stdout + done.stderr).replace("\\n", "|"))

root, results, out = map(Path, sys.argv[1:])
found = ssad.run(
    "precrash", set={"scenarios": ["StraightObstacle/00"], "systems": ["autopilot"]}, out=out / "drive",
    workers=0, quiet=True,
)
print([row["metrics"]["collision"] for row in found.rows], found.report.stat().st_size > 50_000)
told("shift", root, out / "shift", "--shifts", "gaussian", "--severity", "2", "--workers", "1")
told("score", results, "--dataroot", root, "--version", "v1.0-mini", "--split", "mini_val")
told("show", root, out / "show")
told("list")
for words in (
    ("run", "shifts"), ("run", "precrash", "--set", "systems=[ppo]"), ("run", "digital-quick"), ("detect", root, "x"),
    ("train", "driver", "ppo", "--out", "x"), ("list", "attacks"),
    ("run", "adversarial", "--set", "generators=[king]"),
):
    told(*words)
try:
    ssad.make_detector("yolov5n")
except ssad.SSADError as error:
    print(error)
for name in FREE:
    importlib.import_module(f"ssad.{name}")
print(sorted(name for name in sys.modules if name.startswith("torch")))
"""
)


@pytest.fixture
def without(tmp_path: Path) -> dict[str, str]:
    """An environment for processes, and those that they start, without torch."""
    for name in ("torch", "torchvision"):
        (tmp_path / "absent" / name).mkdir(parents=True)
        (tmp_path / "absent" / name / "__init__.py").write_text(ABSENT)
    path = [str(tmp_path / "absent"), str(Path(__file__).parents[1]), *sys.path]
    return os.environ | {"PYTHONPATH": os.pathsep.join(path)}


def run(code: str, environment: dict[str, str], *words: Path) -> list[str]:
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_drives_shifts_scores_and_reports_work_and_the_rest_names_the_extra(
    tiny_set: Path, tmp_path: Path, without: dict[str, str]
) -> None:
    results = perfect(tiny_set, tmp_path / "results.json")
    said = run(DEEDS, without, tiny_set, results, tmp_path)
    assert said[0] == "[False] True"
    for line, part in zip(said[1:5], ("files shifted", "NDS", "show", "attacks:"), strict=True):
        assert line.startswith("0 "), line
        assert part in line
    assert (tmp_path / "show" / "index.html").is_file()
    for line in said[5:12]:
        assert line.startswith("2 error: "), line
        assert line.count("|") == 1, "one line"
        assert "needs the extra perception (torch is not installed); " in line
        assert "--extra perception)" in line
    assert said[12].startswith("detector 'yolov5n' needs the extra perception")
    assert said[13] == "[]"


@pytest.mark.slow
def test_only_what_perceives_or_learns_needs_torch(without: dict[str, str]) -> None:
    failed = json.loads(run(WALK, without)[-1])
    assert len(failed) > 60
    assert [name for name in failed if not name.removeprefix("ssad.").startswith(NEEDS)] == []
    assert [name for name in failed if name.removeprefix("ssad.") in FREE] == []


def test_the_hint_of_an_installed_wheel_names_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """There the extra cannot be named: the distribution is on no index."""
    stated = [
        "numpy>=1.26",
        "torch>=2.15.0; extra == 'perception'",
        'torchvision>=0.29; extra == "perception"',
        "carla==0.9.16; python_version < '3.13' and extra == 'carla'",
    ]
    monkeypatch.setattr(errors, "__file__", "/env/lib/python3.12/site-packages/ssad/core/errors.py")
    monkeypatch.setattr(errors, "requires", lambda name: stated)
    monkeypatch.setattr(errors.importlib.util, "find_spec", lambda name: None)
    hint = errors.install_extra("perception")
    assert hint == f"run: uv pip install --python {sys.executable} 'torch>=2.15.0' 'torchvision>=0.29'"
    monkeypatch.setattr(errors.importlib.util, "find_spec", lambda name: object())
    assert errors.install_extra("carla") == f"run: {sys.executable} -m pip install 'carla==0.9.16'"
