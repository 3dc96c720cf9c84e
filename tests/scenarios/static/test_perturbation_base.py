"""What the base of perturbations says of one that overrides nothing."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from ssad.core.errors import ConfigError
from ssad.scenarios.static.perturbation import EGO, Perturbation, PerturbedScene, RecordedScene

ANY = cast("Any", None)


class Idle(Perturbation):
    """Overrides nothing."""

    name, family = "idle?a=1", "own"


class OnOthers(Idle):
    """Needs another agent, or a recorded target."""

    @property
    def needs_target(self) -> bool:
        return True


def test_it_is_on_the_ego_and_needs_nothing() -> None:
    idle = Idle()
    assert idle.applies_to(ANY, ANY) == EGO == 0, "agent 0 of a trace is the ego"
    assert (idle.severity, idle.target) == (1, "")
    assert len(idle.version()) == 12, "the source of a class that is not SSAD's decides its results"
    assert (idle.needs_target, idle.needs_victim) == (False, False)


def test_its_folder_names_it_and_its_severity() -> None:
    plain, with_settings = Idle(), Idle()
    plain.name, plain.severity = "idle", 2
    assert plain.folder == "idle-2"
    assert with_settings.folder.startswith("idle-a-1-1")
    assert "?" not in with_settings.folder, "some systems have no file of that name"


def test_it_refuses_where_it_does_not_act() -> None:
    for act, words in (
        (lambda one: one.in_loop(ANY, target=0, victim=None, seed=0), "does not act in the closed loop"),
        (lambda one: one.on_target(ANY), "does not act on a recorded target; give it recorded scenes"),
        (lambda one: one.on_scene(ANY, None), "does not act on recorded scenes: it acts in the loop"),
    ):
        with pytest.raises(ConfigError, match=r"own 'idle\?a=1' ") as refused:
            act(Idle())
        assert str(refused.value).endswith(words)
    with pytest.raises(ConfigError, match=r"recorded scenes: it needs a recorded target \(ssad record --target\)"):
        OnOthers().on_scene(ANY, None)


def test_a_target_is_compared_with_its_clean_images() -> None:
    images = SimpleNamespace(clean=lambda: iter([("drive", 1, 2)]))
    assert list(Idle().clean_target(cast("Any", images))) == [("drive", 1, 2)]


def test_a_perturbed_scene_is_unmodified_unless_said() -> None:
    scene = PerturbedScene()
    assert (scene.load_images, scene.ahead, scene.images_at_once) == (None, True, 0)
    assert dict(scene.notes()) == {}
    assert scene.done() is None  # type: ignore[func-returns-value]


def test_a_recorded_scene_keeps_nothing_unless_said() -> None:
    scene = RecordedScene(Path(), "v1.0-mini", ANY)
    assert (scene.seed, scene.device, scene.folder, scene.inputs) == (0, "cpu", None, ())
    assert scene.batch == 12
