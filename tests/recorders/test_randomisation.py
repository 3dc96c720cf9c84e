"""Randomisation of recordings: its draws, what they do to cameras and bodies, and what datasets say of them."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ssad.core.errors import ConfigError, FormatError, UnknownNameError
from ssad.core.images import encode_jpeg
from ssad.recorders.nuscenes import Recording, record_nuscenes
from ssad.recorders.randomisation import (
    COLOUR_PAINTS,
    COLOUR_SHARES,
    DIMENSIONS,
    FULL_RANDOMISATION,
    NO_RANDOMISATION,
    CameraDraw,
    Randomisation,
    parse_randomisation,
    white_balance,
)
from ssad.recorders.target_images import image_rows, record_target_images, recorded_views
from ssad.recorders.target_recording import TargetRecording
from ssad.rendering.bodies import PAINTS
from ssad.rendering.camera.render import SceneWeather, render
from ssad.rendering.camera.rig import rig_camera
from ssad.rendering.camera.sensor import SENSOR
from ssad.rendering.scene_objects import ObjectBody
from ssad.rendering.target import parse_target

CAMERA = rig_camera("CAM_FRONT", 160)
CAR = ObjectBody(
    7, "car", "sedan", (4.5, 1.8, 1.5), (0.1, 0.2, 0.3), (0,), np.zeros((1, 4)), np.ones(1, bool), np.zeros(1)
)


def test_names_and_files_choose_dimensions(tmp_path: Path) -> None:
    assert parse_randomisation("none") == NO_RANDOMISATION
    assert not NO_RANDOMISATION
    assert parse_randomisation("all") == FULL_RANDOMISATION
    assert set(parse_randomisation("all,-focal,-glare").identity()) == set(DIMENSIONS) - {"focal", "glare"}
    assert parse_randomisation("noise, dirt") == parse_randomisation("dirt,noise")
    file = tmp_path / "mine.yaml"
    file.write_text("noise: [0.01, 0.02]\ndirt: true\nwear: false\n")
    expected = {"dirt": [DIMENSIONS["dirt"].low, DIMENSIONS["dirt"].high], "noise": [0.01, 0.02]}
    assert parse_randomisation(str(file)).identity() == expected
    assert Randomisation.of(expected) == parse_randomisation(str(file))


def test_what_cannot_be_drawn_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match=r"unknown dimension 'focus'.*ssad list dimensions"):
        parse_randomisation("all,-focus")
    for content, message in (
        ("noise: [0.02, 0.01]", "noise from 0.02 to 0.01; give a range within"),
        ("compression: [90, 120]", "within 5 to 100"),
        ("noise: often", "expected true, false or"),
        ("- noise", "expected names of dimensions"),
    ):
        file = tmp_path / "mine.yml"
        file.write_text(content)
        with pytest.raises(ConfigError, match=message):
            parse_randomisation(str(file))
    with pytest.raises(FormatError):
        parse_randomisation(str(tmp_path / "none.yaml"))


def test_draws_stay_in_their_ranges_and_do_not_depend_on_each_other() -> None:
    draws = [FULL_RANDOMISATION.draw_camera((number,)).values for number in range(40)]
    for name, value in ((name, value) for draw in draws for name, value in draw.items()):
        assert DIMENSIONS[name].low <= value <= DIMENSIONS[name].high
    assert {name for name, dimension in DIMENSIONS.items() if dimension.subject == "camera"} == set(draws[0])
    assert all(len({draw[name] for draw in draws}) == 40 for name in draws[0])
    fewer = parse_randomisation("all,-focal").draw_camera((0,)).values
    assert fewer == {name: value for name, value in draws[0].items() if name != "focal"}


def test_a_camera_without_draws_is_the_camera_itself() -> None:
    draw = NO_RANDOMISATION.draw_camera(("any",))
    assert (draw.camera(CAMERA).to_ego == CAMERA.to_ego).all()
    assert (draw.camera(CAMERA).intrinsic == CAMERA.intrinsic).all()
    assert draw.sensor(SENSOR, CAMERA) == SENSOR
    assert draw.weather(SceneWeather()) == SceneWeather()
    assert draw.quality(90) == 90
    assert NO_RANDOMISATION.randomise_bodies([CAR], ("any",)) == [CAR]


def test_a_camera_has_the_drawn_place_and_response() -> None:
    values = {"focal": 1.25, "height": 0.4, "pitch": 2.0, "exposure": -0.5, "noise": 0.02, "glare": 0.3}
    draw = CameraDraw(values | {"compression": 71.6, "white-balance": 20.0})
    camera = draw.camera(CAMERA)
    assert camera.intrinsic[[0, 1], [0, 1]] == pytest.approx(1.25 * CAMERA.intrinsic[[0, 1], [0, 1]])
    assert camera.to_ego[2, 3] == pytest.approx(CAMERA.to_ego[2, 3] + 0.4)
    assert np.degrees(np.arcsin(camera.to_ego[2, 2])) == pytest.approx(2.0)
    assert camera.to_ego[:3, :3] @ camera.to_ego[:3, :3].T == pytest.approx(np.eye(3))
    assert np.linalg.det(camera.to_ego[:3, :3]) == pytest.approx(1.0)
    sensor = draw.sensor(SENSOR, camera)
    assert (sensor.noise, sensor.glare, sensor.balance) == (0.02, 0.3, white_balance(20.0, 0.0))
    assert sensor.focal == pytest.approx(camera.intrinsic[0, 0] / 160)
    assert draw.weather(SceneWeather(exposure=0.2)).exposure == pytest.approx(-0.3)
    assert draw.quality(90) == 72


def test_the_white_balance_follows_black_bodies() -> None:
    """Ratios of Planck's law at 5,500 K and at the temperature that is 30 mired lower."""

    def planck(wavelength: float, temperature: float) -> float:
        return 1.0 / np.expm1(1.4388e7 / (wavelength * temperature))

    warm = 1e6 / (1e6 / 5500 + 30)
    ratios = np.array([planck(wavelength, warm) / planck(wavelength, 5500) for wavelength in (600, 540, 450)])
    assert white_balance(30.0, 0.0) == pytest.approx(ratios / ratios[1], rel=0.02)
    assert white_balance(0.0, 0.03) == (1.0, 1.03, 1.0)


def test_cars_have_the_published_colours() -> None:
    randomisation = Randomisation((("paint", 0.0, 0.0),))
    paints = {PAINTS[name]: colour for colour, names in COLOUR_PAINTS.items() for name in names}
    drawn = Counter(paints[randomisation.randomise_body(CAR, (number,)).paint] for number in range(1500))
    for colour, share in COLOUR_SHARES.items():
        assert drawn[colour] / 1500 == pytest.approx(share / sum(COLOUR_SHARES.values()), abs=0.04), colour


def test_vehicles_and_nobody_else_get_dirty() -> None:
    bodies = [CAR, replace(CAR, kind="truck", tag=8), replace(CAR, kind="pedestrian", tag=9)]
    car, truck, walker = FULL_RANDOMISATION.randomise_bodies(bodies, ("drive",))
    assert walker == bodies[2]
    assert truck.paint == CAR.paint, "trucks keep their own colours"
    assert car.paint != CAR.paint
    assert car.finish is not None
    assert truck.finish is not None
    assert car.finish != truck.finish
    kept = FULL_RANDOMISATION.randomise_body(CAR, ("drive", 7), has_paint=False)
    assert (kept.paint, kept.finish) == (CAR.paint, car.finish)


def test_a_recording_without_randomisation_keeps_its_identity(tmp_path: Path) -> None:
    for kind in (Recording, TargetRecording):
        assert "randomisation" not in kind(tmp_path).identity()
        drawn = kind(tmp_path, randomisation=parse_randomisation("noise")).identity()
        assert drawn == kind(tmp_path).identity() | {"randomisation": {"noise": [0.004, 0.03]}}


@pytest.mark.slow
def test_images_say_what_was_drawn_and_can_be_drawn_again(tmp_path: Path) -> None:
    recording = TargetRecording(
        tmp_path,
        (("Twinford", 3),),
        (),
        "orbit",
        size=160,
        target=parse_target("van:white:3"),
        distances=(8.0,),
        randomisation=FULL_RANDOMISATION,
    )
    record_target_images(recording, workers=1)
    rows = [row for row, _ in image_rows(tmp_path)]
    assert len({row["randomised"]["noise"] for row in rows}) == 3
    assert all(row["randomised"]["target"]["paint"] == [0.8, 0.8, 0.79] for row in rows)
    assert all(row["randomised"]["target"]["dirt"] > 0.0 for row in rows)
    assert len({row["intrinsic"][0][0] for row in rows}) == 3
    for view, row in zip(recorded_views(tmp_path), rows, strict=True):
        quality = round(row["randomised"]["compression"])
        data = encode_jpeg(render(view.scene, [view.view]).image[0], quality, "420")
        assert data == (tmp_path / "images" / view.file).read_bytes()


@pytest.mark.slow
def test_a_dataset_says_what_was_drawn(tmp_path: Path) -> None:
    recording = Recording(
        tmp_path, ("Twinford",), (), scenes=1, seconds=0.5, width=64, randomisation=FULL_RANDOMISATION
    )
    record_nuscenes(recording, workers=1)
    tables = tmp_path / "v1.0-ssad"
    page = json.loads((tables / "randomisation.json").read_text())
    assert page["ranges"] == FULL_RANDOMISATION.identity()
    (scene,) = page["scenes"].values()
    assert set(scene["cameras"]) == {row["channel"] for row in json.loads((tables / "sensor.json").read_text())} - {
        "LIDAR_TOP"
    }
    focal = {
        round(row["camera_intrinsic"][0][0], 6)
        for row in json.loads((tables / "calibrated_sensor.json").read_text())
        if row["camera_intrinsic"]
    }
    expected = {
        round(float(rig_camera(channel, 64).intrinsic[0, 0] * values["focal"]), 6)
        for channel, values in scene["cameras"].items()
    }
    assert focal == expected
    assert any(vehicle["dirt"] > 0.0 for vehicle in scene["vehicles"].values())
