"""Environment probes, which glass, paint and metal of a view mirror.

A probe is a panorama with distances, rendered from the street around the view. All views within a square of the map
share one, so that a driving camera needs a new one only every few metres, and a picture depends on its view alone.
Moving bodies are not part of it; in a scene without a street, the objects of the view take its place.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ssad.core.types import F64
from ssad.rendering.camera.kernels import probe as kernels
from ssad.rendering.camera.kernels import probe_light, shade, sky
from ssad.rendering.camera.lamps import nearby_lights, struct_array
from ssad.rendering.camera.scene import ObjectTable, RenderScene, collect_objects
from ssad.rendering.camera.street_lighting import UNLIT
from ssad.rendering.camera.visibility import VisibilityPass, empty_sun_map, sun_map

if TYPE_CHECKING:
    from ssad.rendering.camera.render import View

SIZE = 64  # texels along an eighth of the horizon, about 1.4 degrees each
SIDE = 256  # samples along each side of the views that a probe is made of
SQUARE = 8.0  # m: views in one square of the map share a probe
HEIGHT = 2.2  # m above the ground
REACH = (20.0, 70.0)  # m up to which the street is drawn in full, and without small objects
FAR, FAR_UP = 300.0, 60.0  # m up to which it is drawn at all, to the sides and upwards
SUN_SIZE, SUN_REACH = 512, 60.0  # texels and m of the shadow map of a probe
PROBES_IN_MEMORY, VIEWS_IN_MEMORY = 48, 12  # of each scene
MAX_PROBES = 512  # in memory, where more cameras than `PROBES_IN_MEMORY` take turns


@dataclass(slots=True)
class ProbeStore:
    """Probes of a scene that were used last.

    Attributes:
        texels: Lit probes by place and light.
        views: Visibility passes by place.
        dropped: Keys of the probes that were dropped last.
        capacity: Number of probes that are kept.
    """

    texels: OrderedDict[Any, Any] = field(default_factory=OrderedDict)
    views: OrderedDict[Any, VisibilityPass] = field(default_factory=OrderedDict)
    dropped: OrderedDict[Any, None] = field(default_factory=OrderedDict)
    capacity: int = PROBES_IN_MEMORY

    def keep_texels(self, key: Any, texels: Any) -> None:
        """Keep a probe, and drop the least recently used ones beyond the capacity."""
        if key in self.dropped:
            # A probe that is wanted again soon after it was dropped shows that many cameras take turns.
            del self.dropped[key]
            self.capacity = min(self.capacity + 1, MAX_PROBES)
        self.texels[key] = texels
        while len(self.texels) > self.capacity:
            _keep(self.dropped, self.texels.popitem(last=False)[0], None, self.capacity)


def no_probes(scene: RenderScene) -> Any:
    """Return the table of the kernels for views without probes."""
    return scene.compute_once("no probes", lambda: _probe_table(scene, [], [], []))


def gather_probes(
    scene: RenderScene, views: Sequence[View], lights: Sequence[tuple[Any, ...]], *, shadows: bool, lamps: bool
) -> Any:
    """Return the probes of B views for the kernels.

    Args:
        scene: The scene.
        views: The views.
        lights: Light of each view, rows of `sky.Light`.
        shadows: Whether the sun throws shadows.
        lamps: Whether the lamps of the street light it.
    """
    store: ProbeStore = scene.compute_once("probes", ProbeStore)
    texels: list[Any] = []
    centres: list[F64] = []
    rows: list[int] = []
    known_rows: dict[Any, int] = {}
    for view, light in zip(views, lights, strict=True):
        if scene.street is None:
            # The objects of a view are its surroundings.
            centre = np.array([*view.pose[:2, 3], max(float(view.pose[2, 3]), HEIGHT)])
            place: Any = (id(view.objects), *centre.tolist())
        else:
            place = tuple(np.floor(view.pose[:2, 3] / SQUARE).astype(int).tolist())
            centre = np.array([*((np.array(place) + 0.5) * SQUARE), HEIGHT])
        place = (place, view.weather.lighting == UNLIT)
        key = (place, view.weather.lighting, light, shadows, lamps)
        if key not in known_rows:
            known_rows[key] = len(texels)
            lit_texels = store.texels.pop(key, None) if scene.street is not None else None
            if lit_texels is None:
                visible = store.views.pop(place, None) if scene.street is not None else None
                if visible is None:
                    visible = _probe_views(scene, view, centre)
                if scene.street is not None:
                    _keep(store.views, place, visible, VIEWS_IN_MEMORY)
                lit_texels = _light_probe(scene, view, light, centre, visible, shadows=shadows, lamps=lamps)
            if scene.street is not None:
                store.keep_texels(key, lit_texels)
            texels.append(lit_texels)
            centres.append(centre)
        rows.append(known_rows[key])
    return _probe_table(scene, centres, texels, rows)


def _keep(memory: OrderedDict[Any, Any], key: Any, value: Any, count: int) -> None:
    """Keep the values that were used last."""
    memory[key] = value
    if len(memory) > count:
        memory.popitem(last=False)


def _probe_table(scene: RenderScene, centres: list[F64], texels: list[Any], rows: list[int]) -> Any:
    """Return probes as the kernels take them."""
    device = scene.device
    table = kernels.Probes()
    table.is_on, table.size = int(bool(texels)), SIZE
    if not texels:
        table.texels = wp.zeros((1, 1), dtype=wp.vec4, device=device)
    elif len(texels) == 1:
        table.texels = texels[0]
    else:
        table.texels = wp.empty((len(texels), texels[0].shape[1]), dtype=wp.vec4, device=device)
        for index, probe_texels in enumerate(texels):
            wp.copy(table.texels, probe_texels, dest_offset=index * probe_texels.shape[1])
    table.row = wp.array(np.array(rows or [0], np.int32), dtype=int, device=device)
    table.centre = wp.array(np.array(centres or [np.zeros(3)], np.float32), dtype=wp.vec3, device=device)
    return table


def _probe_views(scene: RenderScene, view: View, centre: F64) -> VisibilityPass:
    """Return the visibility pass towards the four sides and the sky above a place."""
    poses = _probe_poses(centre)
    far = np.array([FAR] * 4 + [FAR_UP])
    draws = scene.gather_draw_calls(
        np.asarray(np.linalg.inv(poses), np.float64),
        _surrounding_objects(scene, [view] * len(poses)),
        eyes=poses[:, :3, 3],
        axes=poses[:, :3, 2],
        reach=REACH,
        far=far,
        street_lit=np.full(len(poses), view.weather.lighting != UNLIT),
    )
    half = SIDE / 2
    lens = np.tile(np.array([half, half, half - 0.5, half - 0.5], np.float32), (len(poses), 1))
    return VisibilityPass(scene, draws, lens, ortho=False, size=(SIDE, SIDE), scale=1)


def _surrounding_objects(scene: RenderScene, views: Sequence[View]) -> ObjectTable:
    """Return the objects that probes show: those of the views in a scene without a street, else none."""
    return collect_objects([view.objects if scene.street is None else () for view in views])


def _probe_poses(centre: F64) -> F64:
    """Return the cameras of a probe, to the world [5, 4, 4]: along x, y, -x and -y, and upwards."""
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = centre
    for index, (x, y) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        # columns: right, down, ahead
        poses[index, :3, :3] = np.array([[y, -x, 0], [0, 0, -1], [x, y, 0]], np.float64).T
    poses[4, :3, :3] = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]], np.float64).T
    return poses


def _light_probe(
    scene: RenderScene,
    view: View,
    light: tuple[Any, ...],
    centre: F64,
    visible: VisibilityPass,
    *,
    shadows: bool,
    lamps: bool,
) -> Any:
    """Return the texels of a probe, all levels one after the other [1, T]."""
    device = scene.device
    poses = _probe_poses(centre)
    bare = replace(view, pose=poses[0], lamps=(), objects=view.objects if scene.street is None else ())
    bodies = _surrounding_objects(scene, [bare])
    near = nearby_lights(scene, [bare], bodies, lamps=lamps, contact=False)
    near.shadows = wp.zeros((1, 2, 2), dtype=wp.uint64, device=device)
    sun_shadows = shade.SunShadows()
    is_up = light[0][2] > 0.02 and max(light[1]) > 0.0
    size = SUN_SIZE if shadows and is_up else 0
    sun_shadows.wide = sun_map(scene, bodies, [light[0]], centre[None], SUN_REACH, size)
    sun_shadows.fine = empty_sun_map(scene)
    count = sum(8 * (SIZE >> level) ** 2 for level in range(int(kernels.LEVELS)))
    texels = wp.empty((1, count), dtype=wp.vec4, device=device)
    lanes = 1 if device == "cpu" else 4 * SIZE
    inputs = [
        scene.geometry,
        visible.draw_ranges,
        wp.array(poses.astype(np.float32), dtype=wp.mat44, device=device),
        wp.array(struct_array(sky.Light, [light]), dtype=sky.Light, device=device),
        sun_shadows,
        near,
        SIZE,
        lanes,
        texels,
    ]
    wp.launch(probe_light.light_probe, dim=(2 * SIZE, lanes), inputs=inputs, device=device)
    start, side = 0, SIZE
    for _ in range(int(kernels.LEVELS) - 1):
        wp.launch(probe_light.halve_probe, dim=(side, 2 * side), inputs=[start, side, texels], device=device)
        start, side = start + 8 * side * side, side // 2
    return texels
