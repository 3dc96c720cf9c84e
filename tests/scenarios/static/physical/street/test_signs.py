"""Changed signs and light on signal heads: to which episodes they apply, and what sensors are told."""

from __future__ import annotations

import numpy as np
import pytest

from ssad import build_episode, load_scenarios, load_town
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.rendering.sensor_suite import SensorSuite
from ssad.scenarios.static.perturbation import EGO
from ssad.scenarios.static.physical.street.signs import HEAD_LUMENS, HeadLight, SignChange, near_route

STICKERS = ("sticker-8", "sticker-blank", "sticker-blocks")


def test_a_sign_that_changes_is_told_to_sensors_alone() -> None:
    (scenario, *_) = load_scenarios("stop-signs")
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    gone, changed = SignChange("stop"), SignChange("stop", "yield")
    kinds = town.sign_kind.copy()
    assert gone.applies_to(episode, town) == EGO
    edit = gone.in_loop(SensorSuite(), target=EGO, victim=None, seed=0).street_edit
    assert edit is not None
    assert edit.signs == {"stop_sign": None}
    replaced = changed.in_loop(SensorSuite(), target=EGO, victim=None, seed=0).street_edit
    assert replaced is not None
    assert replaced.signs["stop_sign"] is not None
    np.testing.assert_array_equal(town.sign_kind, kinds)
    (plain,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    ground = load_town(plain.town)
    assert gone.applies_to(build_episode(plain, ground, seed=0), ground) is None


def test_speed_limit_signs_change_by_their_figures() -> None:
    (scenario, *_) = load_scenarios("stop-signs")
    town = load_town(scenario.town)
    episode = build_episode(scenario, town, seed=0)
    assert SignChange("limit-30").applies_to(episode, town) == EGO
    assert SignChange("limit", "sticker-8").applies_to(episode, town) == EGO
    assert SignChange("limit-60").applies_to(episode, town) is None
    assert SignChange("limit", "limit-30").applies_to(episode, town) is None, "it stays the same"
    gone = SignChange("limit").bodies()
    assert set(gone.values()) == {None}
    assert len(gone) == 14
    assert "limit_sign:80" not in SignChange("limit", "limit-80").bodies()
    assert "limit_sign:80" not in SignChange("limit", "sticker-8").bodies()


def test_a_sticker_and_its_controls_lie_before_the_same_part_of_a_plate() -> None:
    bodies = {into: SignChange("limit-30", into).bodies()["limit_sign:30"] for into in STICKERS}
    papers = []
    for into, body in bodies.items():
        assert body is not None
        names = [material.name for material in body.materials]
        corners = body.corners()
        paper = corners[body.material == names.index("sticker")].reshape(-1, 3)
        plate = corners[body.material == names.index("sign_white")].reshape(-1, 3)
        assert paper[:, 0].min() > plate[:, 0].max()
        assert paper[:, 1].max() < 0.05, "on the left of who reads"
        ink = corners[(body.material == names.index("sign_ink")) & (corners[..., 0].min(1) > paper[0, 0])]
        assert (len(ink) > 0) == (into != "sticker-blank")
        papers.append(paper)
    for paper in papers[1:]:
        np.testing.assert_array_equal(paper, papers[0])


def test_a_cover_hides_the_whole_plate() -> None:
    for sign, kind in (("stop", "stop_sign"), ("yield", "yield_sign"), ("limit-30", "limit_sign:30")):
        body = SignChange(sign, "cover").bodies()[kind]
        assert body is not None
        corners = body.corners()
        front = corners[corners[..., 0].min(1) > corners[..., 0].max() - 1e-4].reshape(-1, 3)
        face = corners[body.panel == body.panels.index("face")].reshape(-1, 3)
        assert (front[:, 1:].min(0) < face[:, 1:].min(0)).all()
        assert (front[:, 1:].max(0) > face[:, 1:].max(0)).all()


def test_the_lamp_on_a_head_lights_its_size() -> None:
    lamp = HeadLight("red", distance=10.0).lamp()
    assert lamp.pose[:3, 3].tolist() == [10.0, 0.0, 0.0]
    np.testing.assert_allclose(lamp.pose[:3, 2], (-1.0, 0.0, 0.0), atol=1e-9)  # back to the head
    assert 2.0 * 10.0 * lamp.spread[0] == pytest.approx(0.3)
    assert lamp.power == HEAD_LUMENS[2]
    assert lamp.colour[0] > lamp.colour[1]
    suite = HeadLight().in_loop(SensorSuite(), target=EGO, victim=None, seed=0)
    assert suite.street_edit is not None
    assert len(suite.street_edit.head_lamps) == 1


def test_places_near_a_route() -> None:
    route = np.array([(0.0, 0.0), (10.0, 0.0)])
    assert near_route(route, np.array([(5.0, 8.0)]))
    assert not near_route(route, np.array([(5.0, 80.0)]))
    assert not near_route(route, np.zeros((0, 2)))


def test_what_is_refused() -> None:
    with pytest.raises(UnknownNameError):
        SignChange("speed")
    with pytest.raises(UnknownNameError):
        SignChange("stop", "moose")
    with pytest.raises(ConfigError, match="stop has no figure for sticker-8"):
        SignChange("stop", "sticker-8")
    for sign, into in (("limit-80", "sticker-8"), ("limit-80", "limit-80")):
        with pytest.raises(ConfigError, match="changes nothing"):
            SignChange(sign, into)
    with pytest.raises(ConfigError, match="changes nothing"):
        SignChange("stop", "stop")
    with pytest.raises(UnknownNameError):
        HeadLight("purple")
    with pytest.raises(ConfigError, match="give 1 to 5, 1 to 60 m"):
        HeadLight(distance=0.0)
