"""Drives as MCAP recordings: read back with the library that viewers use."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town
from ssad.core.errors import ConfigError
from ssad.core.rotations import yaw_to_quaternion
from ssad.core.types import EpisodeTrace, LaneType
from ssad.drivers.perceiving.driver import PerceivingDriver
from ssad.drivers.perceiving.perceivers import PerfectPerceiver, nuscenes_cameras
from ssad.drivers.perceiving.recorder import PerceptionRecorder
from ssad.experiments.gap.drive_sheet import RecordedDrive
from ssad.experiments.gap.mcap import COLOURS, require_mcap, write_mcap
from ssad.world.rollout import rollout


def driven() -> tuple[EpisodeTrace, RecordedDrive, Any]:
    scenario = next(one for one in load_scenarios("precrash") if one.name == "StraightObstacle/00")
    town = load_town(scenario.town)
    cameras = nuscenes_cameras(96)
    watcher = PerceptionRecorder(cameras, 1)
    episode = build_episode(scenario, town, seed=0)
    (trace,) = rollout(World([episode], {town.name: town}), PerceivingDriver(PerfectPerceiver(cameras), watch=watcher))
    pictures = [(0.2 * k, np.full((54, 96, 3), 20 * k, np.uint8)) for k in range(5)]
    return trace, RecordedDrive("", trace, watcher.perception(0), pictures), town


def test_a_recording_has_what_the_driver_saw_found_and_believed(tmp_path: Path) -> None:
    pytest.importorskip("mcap_protobuf", reason="the extra view is not installed")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    trace, seen, town = driven()
    above = (np.full((40, 60, 3), 90, np.uint8) for _ in range(len(trace.x)))
    path = write_mcap(tmp_path / "drive.mcap", trace, town, recorded_drive=seen, top_views=above)
    told: dict[str, list[tuple[float, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message, decoded in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            assert schema.name.startswith("foxglove.")
            told.setdefault(channel.topic, []).append((message.log_time * 1e-9, decoded))
    steps = len(trace.x)
    assert {topic: len(some) for topic, some in told.items() if topic not in ("/detections", "/tf")} == {
        "/map": 1,
        "/truth": steps,
        "/plan": steps,
        "/tracks": len(seen.perceived.tracks),
        "/camera": 5,
        "/camera/calibration": 5,
        "/above": steps,
    }
    for picture, (time, message) in zip(seen.shots, told["/camera"], strict=True):
        shown = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
        assert message.format == "jpeg"
        assert abs(time - picture[0]) < 1e-6
        assert np.abs(shown.astype(int) - picture[1]).max() <= 2
    ego = [(t, m) for t, m in told["/tf"] if m.child_frame_id == "ego"]
    for step, (time, message) in enumerate(ego):
        assert abs(time - step * trace.dt) < 1e-6
        np.testing.assert_allclose([message.translation.x, message.translation.y], [trace.x[step, 0], trace.y[step, 0]])
        np.testing.assert_allclose(message.rotation.z, yaw_to_quaternion(trace.yaw[step, 0])[3])
        assert message.translation.z == 0.0
    (first, *_) = told["/truth"]
    assert len(first[1].entities[0].cubes) == int(trace.active[0].sum())
    found = {round(time, 3): message.entities[0].cubes for time, message in told["/detections"]}
    looks = {round(time, 3): objects for time, objects in seen.perceived.detections if objects is not None}
    assert found.keys() == looks.keys()
    assert max(len(objects) for objects in looks.values()) > 0
    for time, objects in looks.items():
        places = [(cube.pose.position.x, cube.pose.position.y) for cube in found[time]]
        np.testing.assert_allclose(np.reshape(places, (-1, 2)), objects.place)
    believed = [len(tracks) for _, tracks in seen.perceived.tracks]
    assert [len(message.entities[0].cubes) for _, message in told["/tracks"]] == believed
    assert max(believed) > 0
    ((_, streets),) = told["/map"]
    assert len(streets.entities[0].lines) == int((town.kind == LaneType.DRIVING).sum())
    assert (
        path.read_bytes()
        == write_mcap(
            tmp_path / "again.mcap",
            trace,
            town,
            recorded_drive=seen,
            top_views=(np.full((40, 60, 3), 90, np.uint8) for _ in range(steps)),
        ).read_bytes()
    )


def test_without_the_extra_it_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ConfigError, match=r"--mcap needs .*\[view\]"):
        require_mcap()


def test_colours_are_shares() -> None:
    assert all(0.0 <= share <= 1.0 for colour in COLOURS.values() for share in colour)
