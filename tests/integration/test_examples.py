"""Examples of the pages that no other test runs, as they stand there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "docs" / "how-to"


def examples(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)


def run(page: Path, **names: Any) -> dict[str, Any]:
    """The names that the examples of a page leave behind, run one after the other."""
    for block in examples(page):
        exec(block, names)
    return names


@pytest.fixture
def street() -> np.ndarray:
    """Stands for a picture [96, 160, 3]; what is in it does not matter."""
    return np.asarray(np.random.default_rng(0).integers(0, 256, (96, 160, 3)), np.uint8)


def test_gymnasium_in_the_readme() -> None:
    names: dict[str, Any] = {}
    exec(examples(ROOT / "README.md")[1], names)
    view, _ = names["env"].reset(seed=0)
    assert names["env"].observation_space.contains(view)
    views, _ = names["envs"].reset(seed=0)
    assert len(views) == 64


def test_shifts(street: np.ndarray) -> None:
    names = run(FOLDER / "shift-data.md", images=street[None])
    assert names["shifted"].shape == (1, *street.shape)
    assert (names["shifted"] != street).any()


def test_adversaries_by_selection() -> None:
    names = run(FOLDER / "use-adversaries.md")
    assert [trace.driven[-1] > 5.0 for trace in names["traces"]] == [True] * 3


def test_parts_of_a_perceiving_driver() -> None:
    names = run(FOLDER / "perceiving-parts.md")
    assert [trace.end == "collision" for trace in names["traces"]] == [False, False]
    assert names["traces"][0].brake.max() == 1.0  # for the car ahead


def test_a_generator_of_your_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ssad.drivers import make_system
    from ssad.scenarios.dynamic import load_scenarios
    from ssad.scenarios.dynamic.generate import Trials, generator_factory, search
    from ssad.world.roads import load_town

    (block,) = examples(FOLDER / "search-for-collisions.md")
    (tmp_path / "later.py").write_text(block)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    trials = Trials(lambda: make_system("blind"))
    (scenario,) = load_scenarios("RightTurn/00")
    bases = [trials.base(scenario, load_town(scenario.town), seed=0)]
    generator = generator_factory("later:Later")(bases, seeds=[0], budget=3)
    (found,) = search(generator, bases, trials, budget=3)
    assert len({repr(outcome.proposal.scenario) for outcome in found}) == 3


def test_attacks(street: np.ndarray) -> None:
    from helpers.mono3d import TINY, lively, some_truth

    from ssad.core.detections import Truth
    from ssad.detectors import make_detector
    from ssad.scenarios.static.digital import Budget, px, run_attack

    images = torch.from_numpy(street).permute(2, 0, 1)[None].float() / 255
    solid = some_truth(3, size=street.shape[:2], focal=125.0)
    flat, most = Truth(solid.label * 0, solid.box), 5 / 255 + 1e-6
    assert solid.intrinsic is not None
    names = run(FOLDER / "attack-detectors.md")
    names["attacked"].__globals__["make_detector"] = lambda name: lively(TINY)  # of the same build, and quick

    moved, before, after = names["attacked"](images, [solid], solid.intrinsic[None].float())
    assert 0 < float((moved - images).abs().max()) <= most
    assert float(after[0]) > float(before[0])
    own = run_attack(names["Steps"](), make_detector("yolov5n"), images, [flat], Budget(px(5))).images
    assert 0 < float((own - images).abs().max()) <= most
    made = names["attacks"](torch.zeros(1, 3, *street.shape[:2]), solid.intrinsic)
    assert [live.attack.name for live in made.values()] == ["pgd", "universal", "noise"]


def test_detectors(street: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first and the last; the others need official weights or other packages, and tests of their own."""
    import cv2
    from safetensors.torch import save_file

    from ssad.detectors import make_detector

    first, *_, last = examples(FOLDER / "use-detectors.md")
    save_file(make_detector("yolov5s", weights="random").state_dict(), tmp_path / "my.safetensors")
    cv2.imwrite(str(tmp_path / "street.jpg"), street)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(first, names)
    assert names["found"].box.shape[1] == 4
    monkeypatch.syspath_prepend(FOLDER)
    exec(last, {})
