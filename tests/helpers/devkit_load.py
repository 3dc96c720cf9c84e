"""Loads a nuScenes folder with the official toolkit and prints what it finds as JSON.

Run by an interpreter that has nuscenes-devkit: `python devkit_load.py ROOT VERSION`. It uses nothing of SSAD.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

from nuscenes.nuscenes import NuScenes  # type: ignore[import-not-found]


def boxes(data: Any, token: str) -> list[dict[str, Any]]:
    return [
        {
            "token": box.token,
            "name": box.name,
            "centre": list(box.center),
            "size": list(box.wlh),
            "rotation": list(box.orientation.elements),
        }
        for box in data.get_boxes(token)
    ]


def main(root: str, version: str) -> None:
    data = NuScenes(version=version, dataroot=root, verbose=False)
    found: dict[str, Any] = {"scenes": {}, "frames": {}, "velocity": {}, "counts": {}}
    for scene in data.scene:
        chain, token = [], scene["first_sample_token"]
        while token:
            chain.append(token)
            token = data.get("sample", token)["next"]
        assert chain[-1] == scene["last_sample_token"]
        assert len(chain) == scene["nbr_samples"]
        log = data.get("log", scene["log_token"])
        found["scenes"][scene["name"]] = {"samples": chain, "location": log["location"]}
        assert data.get("map", log["map_token"])["mask"].mask().shape[0] > 0
        for sample in chain:
            for first in data.get("sample", sample)["data"].values():
                data.get_sample_data(first)
    for row in data.sample_data:
        if row["prev"]:
            assert data.get("sample_data", row["prev"])["next"] == row["token"]
        pose = data.get("ego_pose", row["ego_pose_token"])
        found["frames"][row["token"]] = {
            "channel": row["channel"],
            "modality": row["sensor_modality"],
            "timestamp": row["timestamp"],
            "key": row["is_key_frame"],
            "ego": pose["translation"],
            "boxes": boxes(data, row["token"]),
        }
    for row in data.sample_annotation:
        velocity = data.box_velocity(row["token"])
        found["velocity"][row["token"]] = [None if math.isnan(value) else value for value in velocity]
        found["counts"][row["token"]] = [row["num_lidar_pts"], row["num_radar_pts"], row["category_name"]]
    for instance in data.instance:
        tokens, token = [], instance["first_annotation_token"]
        while token:
            tokens.append(token)
            token = data.get("sample_annotation", token)["next"]
        assert len(tokens) == instance["nbr_annotations"]
        assert tokens[-1] == instance["last_annotation_token"]
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(*sys.argv[1:3])
