"""Contract of the four open-loop kinds: what they take, what they refuse, and with which words."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.engine.kind import Cell, CellError, Job
from ssad.experiments.perception import open_loop
from ssad.experiments.perception.digital.kind import Digital
from ssad.experiments.perception.kind import Perception
from ssad.experiments.perception.open_loop import OpenLoopKind, TargetCondition
from ssad.experiments.perception.physical.kind import Physical
from ssad.experiments.perception.physical.lit_images import RelightableTargetImages
from ssad.experiments.perception.scene_boxes import Examination, SceneCondition
from ssad.experiments.perception.scored_data import Victims
from ssad.experiments.perception.shifts.kind import Detection
from ssad.metrics.target_attacks import TargetSighting
from ssad.scenarios.static.catalogue import parse_perturbation
from ssad.scenarios.static.perturbation import Perturbation

KINDS = (Detection, Digital, Physical, Perception)
KEYS = [("shift", Detection, "shifts"), ("digital", Digital, "attacks")]
KEYS += [("texture", Physical, "attacks"), ("light", Physical, "lights")]
NAMES = {"shift": "fog", "digital": "pgd", "texture": "grey", "light": "laser", "fault": "blackout"}
TARGETS = ("texture", "light")


@pytest.fixture(autouse=True)
def no_detectors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Detectors are names, and data are not looked at."""
    for kind in KINDS:
        monkeypatch.setattr(kind, "victims", lambda self, suite: Victims({"one": "hash"}, {"one": ""}, {"one": "2d"}))
    for kind in (Detection, Digital):
        monkeypatch.setattr(kind, "data", lambda self, suite: {"scenes": "some"})


def cells_of(kind: type[OpenLoopKind], **changes: Any) -> tuple[Cell, ...]:
    suite = kind.suite.model_validate({"kind": kind.name, "name": "t", "detectors": ["one"], **changes})
    return kind().plan(suite).cells


def perturbation(family: str) -> Perturbation:
    return parse_perturbation(NAMES[family]).make(3)


@pytest.mark.parametrize(("family", "preset", "key"), KEYS)
def test_a_preset_takes_the_names_of_its_family_as_perception_does(
    family: str, preset: type[OpenLoopKind], key: str
) -> None:
    for kind, suite_key in ((preset, key), (Perception, "perturbations")):
        cells = cells_of(kind, **{suite_key: [NAMES[family]]})
        assert len(cells) >= 2, "the clean data, and those under the perturbation"
        assert len({cell.key for cell in cells}) == len(cells)


def test_a_name_of_two_families_is_the_one_that_the_preset_takes() -> None:
    for kind in (Digital, Physical):
        assert len(cells_of(kind, attacks=["noise"])) >= 2


@pytest.mark.parametrize(("family", "preset", "key"), KEYS)
def test_a_preset_refuses_every_other_family_with_the_same_words(
    family: str, preset: type[OpenLoopKind], key: str
) -> None:
    for other, name in NAMES.items():
        if other != family:
            with pytest.raises(UnknownNameError) as found:
                cells_of(preset, **{key: [name]})
            assert str(found.value) == (
                f"suite t: {key}: '{name}' is of the family {other}, not {family}; suites of kind perception take "
                "every family"
            )


@pytest.mark.parametrize("family", [family for family in NAMES if family not in TARGETS])
def test_what_acts_on_scenes_is_refused_on_a_target_with_the_same_words(
    family: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = perturbation(family)
    images = RelightableTargetImages(tmp_path, 1)
    monkeypatch.setattr(open_loop, "cached_detector", lambda *given, **options: None)
    monkeypatch.setattr(open_loop, "_clean_sightings", lambda *given: (seen(0.0),))
    job = Job(tmp_path, "cpu", {"detectors": {}, "replicates": 0, "seed": 0, "floor": 0.0})
    for kind in (Physical, Perception):
        monkeypatch.setattr(kind, "scenes", lambda self, cell, job: ())
        monkeypatch.setattr(kind, "target", lambda *given: TargetCondition(images, refused, "sedan"))
        cell = Cell("key", "cell", "one", 0, {}, {})
        with pytest.raises(ConfigError, match=f"^{refused.family} '{refused.name}' does not act on a recorded target"):
            kind().result(cell, job)


@pytest.mark.parametrize("family", TARGETS)
def test_what_acts_on_a_target_is_refused_on_scenes_with_the_same_words(family: str, tiny_set: Path) -> None:
    from ssad.datasets.nuscenes.reader import NuScenes

    refused = perturbation(family)
    examination = Examination(tiny_set, tiny_set, "v1.0-mini", (("one", ""),), 0, "cpu", 1)
    with NuScenes(tiny_set, None) as data:
        condition = SceneCondition(data.scenes()[0].name, refused)
        with pytest.raises(ConfigError, match=f"^{refused.family} '{refused.name}' does not act on recorded scenes"):
            condition.present(examination, data, [])


def seen(score: float) -> TargetSighting:
    """A target that is found with a score; 0: it is not."""
    box = np.array([[0.0, 0.0, 9.0, 9.0]])
    found = box if score else np.zeros((0, 4))
    return TargetSighting("a", found, np.full(len(found), score), box, np.zeros(1, bool))


def test_the_floor_is_the_same_and_the_clean_target_is_seen_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Shown(Perturbation):
        name, family = "own", "own"

        def on_target(self, images: Any) -> Iterator[Any]:
            return iter([0.0])

    images = RelightableTargetImages(tmp_path, 1)
    shown: list[Any] = []

    def sightings(detector: Any, given: Any) -> Iterator[TargetSighting]:
        shown.extend(given)
        yield seen(0.0)

    monkeypatch.setattr(RelightableTargetImages, "clean", lambda self: iter(["clean"]))
    monkeypatch.setattr(open_loop, "cached_detector", lambda *given, **options: None)
    monkeypatch.setattr(open_loop, "sightings", sightings)
    cell = Cell("key", "cell", "one", 0, {"view": "drive"}, {})
    for kind in (Physical, Perception):
        monkeypatch.setattr(kind, "scenes", lambda self, cell, job: ())
        monkeypatch.setattr(kind, "target", lambda *given: TargetCondition(images, Shown(), "sedan"))
        settings = {"detectors": {}, "replicates": 0, "seed": 0}
        with pytest.raises(CellError, match=r"^one finds the clean sedan with AP50 0\.000, which is less than"):
            kind().result(cell, Job(tmp_path, "cpu", settings | {"floor": 0.9}))
        assert kind().result(cell, Job(tmp_path, "cpu", settings | {"floor": 0.0}))["clean_AP50"] == 0.0
    assert shown == ["clean", 0.0, 0.0]


@pytest.mark.parametrize(("floor", "rate"), [(0.4, 0.0), (0.9, None)])
def test_a_rate_is_held_to_the_floor_of_the_suite_at_its_own_score(
    floor: float, rate: float | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clean target is found in both images, so AP50 passes; above 0.25 it is found in one."""

    class Shown(Perturbation):
        name, family = "own", "own"

        def on_target(self, images: Any) -> Iterator[Any]:
            return iter([])

    def sightings(detector: Any, given: Any) -> Iterator[TargetSighting]:
        yield from (seen(0.9), seen(0.1))

    monkeypatch.setattr(RelightableTargetImages, "clean", lambda self: iter([]))
    monkeypatch.setattr(open_loop, "cached_detector", lambda *given, **options: None)
    monkeypatch.setattr(open_loop, "sightings", sightings)
    images = RelightableTargetImages(tmp_path, 2)
    monkeypatch.setattr(Perception, "scenes", lambda self, cell, job: ())
    monkeypatch.setattr(Perception, "target", lambda *given: TargetCondition(images, Shown(), "sedan"))
    settings = {"detectors": {}, "replicates": 0, "seed": 0, "floor": floor}
    result = Perception().result(Cell("key", "cell", "one", 0, {"view": "drive"}, {}), Job(tmp_path, "cpu", settings))
    assert result["clean_AP50"] == 1.0
    assert (result["metrics"]["ASR_25"], result["metrics"]["n0_25"]) == (rate, 1)
