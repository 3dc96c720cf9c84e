"""Edits of the street in the closed loop that stay in their place: textures on the road, lamps, bodies and signs.

An edit changes what sensors see. Contacts, traffic and the map stay as they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.rotations import upright_pose
from ssad.core.types import F64
from ssad.rendering.camera.lamps import SceneLamp
from ssad.rendering.camera.photometry import per_lux
from ssad.rendering.camera.render import View
from ssad.rendering.camera.scene import SceneObject
from ssad.rendering.camera.scene_edit import NO_EDIT, SceneEdit
from ssad.rendering.meshes.mesh import Mesh

HEADS_WITHIN = 80.0  # m from the eye within which lamps on signal heads are rendered


@dataclass(frozen=True, eq=False)
class StreetEdit:
    """Edit of the street around a place on the route of each episode, for `ssad.rendering.onboard.Onboard`.

    Attributes:
        edit: Decals and lamps in the frame of the place: x along the route, y to the left, z up; powers in lumen.
        place: Distance along the route and offset to the left of it, m.
        bodies: Bodies with their poses [4, 4] in the frame of the place.
        signs: Kind of the town's signs (stop_sign, yield_sign or limit_sign, or "limit_sign:30" for those of 30 km/h)
            -> body that stands in place of each of them; None removes them.
        head_lamps: Lamps that shine on every signal head, in its frame (x away from its face); powers in lumen.

    Raises:
        ConfigError: The edit has layers or cards, which need a target, or the place is not finite.
    """

    edit: SceneEdit = NO_EDIT
    place: tuple[float, float] = (0.0, 0.0)
    bodies: tuple[tuple[Mesh, F64], ...] = ()
    signs: Mapping[str, Mesh | None] = field(default_factory=dict)
    head_lamps: tuple[SceneLamp, ...] = ()

    def __post_init__(self) -> None:
        if self.edit.layers or self.edit.cards:
            raise ConfigError("edit of the street: layers and cards need a target; use decals and lamps")
        if not np.isfinite(self.place).all() or self.place[0] < 0.0:
            raise ConfigError(
                f"edit of the street: place {self.place}; give a distance along the route from 0, and an offset, in m"
            )

    def meshes(self) -> dict[Any, Mesh]:
        """Return the meshes that the scene must hold, by name."""
        named: dict[Any, Mesh] = {("street edit", id(self), index): body for index, (body, _) in enumerate(self.bodies)}
        replacements = {kind: mesh for kind, mesh in self.signs.items() if mesh is not None}
        return named | {("street edit sign", id(self), kind): mesh for kind, mesh in replacements.items()}

    def pose(self, route: F64) -> F64:
        """Return the place in the world [4, 4]: at the end of a route [N, 2] that is too short for it."""
        return route_pose(route, *self.place)

    def objects(
        self,
        scene_objects: tuple[SceneObject, ...],
        route: F64,
        index: Mapping[Any, int],
        sign_kinds: Mapping[int, str],
    ) -> tuple[SceneObject, ...]:
        """Return the objects of a view with the edit's bodies, and its signs in place of the town's.

        Args:
            scene_objects: Objects of the view.
            route: Route of the episode [N, 2].
            index: Number in the scene of each of `meshes`.
            sign_kinds: Number of the mesh of each of the town's signs -> its kind, with the figures of a limit.
        """
        changed = []
        for scene_object in scene_objects:
            kind = sign_kinds.get(scene_object.mesh) if scene_object.tag == 0 else None
            names = () if kind is None else (kind, kind.partition(":")[0])
            name = next((name for name in names if name in self.signs), None)
            if name is None:
                changed.append(scene_object)
            elif self.signs[name] is not None:
                changed.append(replace(scene_object, mesh=index["street edit sign", id(self), name]))
        place = self.pose(route) if self.bodies else np.eye(4)
        changed += [
            SceneObject(index["street edit", id(self), number], place @ pose)
            for number, (_, pose) in enumerate(self.bodies)
        ]
        return tuple(changed)

    def on(self, view: View, route: F64, heads: F64) -> View:
        """Return a view with the decals and lamps of the edit.

        Args:
            view: The view.
            route: Route of the episode [N, 2].
            heads: Signal heads [H, 4]: x, y, z, yaw.
        """
        scale = per_lux(view.weather)
        lamps, decals = list(view.lamps), list(view.decals)
        if self.edit.lamps or self.edit.decals:
            place = self.pose(route)
            lamps += [replace(entry, pose=place @ entry.pose, power=entry.power * scale) for entry in self.edit.lamps]
            decals += [replace(entry, pose=place @ entry.pose) for entry in self.edit.decals]
        if self.head_lamps and len(heads):
            distances = np.hypot(heads[:, 0] - view.pose[0, 3], heads[:, 1] - view.pose[1, 3])
            for x, y, z, yaw in heads[distances < HEADS_WITHIN].astype(np.float64).tolist():
                head = upright_pose(x, y, yaw, z)
                lamps += [
                    replace(entry, pose=head @ entry.pose, power=entry.power * scale) for entry in self.head_lamps
                ]
        return replace(view, lamps=tuple(lamps), decals=tuple(decals))


def route_pose(route: F64, distance: float, lateral: float = 0.0) -> F64:
    """Return the pose [4, 4] of a place on a route: x along it, y to the left, z up.

    Args:
        route: Points [N, 2], m.
        distance: m along it; its end, where it is shorter.
        lateral: m to the left.
    """
    points = np.asarray(route, np.float64)
    lengths = np.hypot(*np.diff(points, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(lengths)])
    segment = int(np.clip(np.searchsorted(arc, distance, side="right") - 1, 0, len(lengths) - 1))
    share = float(np.clip((distance - arc[segment]) / max(lengths[segment], 1e-9), 0.0, 1.0))
    x, y = points[segment] + share * (points[segment + 1] - points[segment])
    direction = points[segment + 1] - points[segment]
    yaw = float(np.arctan2(direction[1], direction[0]))
    return upright_pose(float(x) - lateral * np.sin(yaw), float(y) + lateral * np.cos(yaw), yaw)
