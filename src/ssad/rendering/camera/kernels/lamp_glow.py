"""Light of lit lamps beyond that of an image, which the lens scatters."""

import warp as wp

from ssad.rendering.camera.kernels.light import lamp_emission
from ssad.rendering.camera.kernels.raster import LAST
from ssad.rendering.camera.kernels.shade import DrawRanges, Geometry, hit_of
from ssad.rendering.camera.kernels.sky import Light, air_transmission

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def take_lamps(
    geometry: Geometry,
    draw_samples: DrawRanges,
    lens: wp.array(dtype=wp.vec4),
    to_world: wp.array(dtype=wp.mat44),
    lights: wp.array(dtype=Light),
    gains: wp.array(dtype=float),
    is_glowing: wp.array(dtype=int),
    scale: int,
    lanes: int,
    out: wp.array3d(dtype=wp.vec3),
):
    """Compute the light that lamps emit beyond that of the image, out [B, H, W].

    What a lamp reflects does not count, so that the light depends on no paint and no texture. gains: see
    `ssad.rendering.camera.glare.lamp_gains`; is_glowing [B]: 1 for views whose lens scatters; lanes: threads of a row.
    """
    view, y, lane = wp.tid()
    light = lights[view]
    share = 1.0 / float(scale * scale)
    # Neighbours mostly show the same surface: what is no lamp is looked up once.
    dark_key = wp.uint64(0)
    for x in range(lane, out.shape[2], lanes):
        total = wp.vec3(0.0, 0.0, 0.0)
        if is_glowing[view] == 1 and light.lamps > 0.0:
            for sample in range(scale * scale):
                row = y * scale + sample / scale
                column = x * scale + sample % scale
                key = draw_samples.samples[view, row, column] & LAST
                if key != dark_key:
                    slot = int(LAST - key)
                    owner = draw_samples.owners[slot / 2]
                    gain = gains[geometry.material[owner[1]]]
                    if gain <= 0.0:
                        dark_key = key
                    else:
                        focal = lens[view]
                        u = (float(column) + 0.5) / float(scale) - 0.5
                        v = (float(row) + 0.5) / float(scale) - 0.5
                        ray = wp.vec3((u - focal[2]) / focal[0], (v - focal[3]) / focal[1], 1.0)
                        hit = hit_of(geometry, draw_samples, slot, ray, to_world[view])
                        surface = geometry.surfaces[geometry.material[owner[1]]]
                        to_camera = draw_samples.matrices[owner[0]]
                        leftward = wp.vec3(to_camera[0, 1], to_camera[1, 1], to_camera[2, 1])
                        middle = wp.vec3(to_camera[0, 3], to_camera[1, 3], to_camera[2, 3])
                        side = wp.dot(leftward, ray * hit.z - middle)
                        state = draw_samples.lit[owner[0]]
                        emission = lamp_emission(surface, state, side, draw_samples.split[owner[0]], light.lamps)
                        clearness = air_transmission(light, hit.distance)
                        total = total + wp.cw_mul(emission, clearness) * (gain * light.lamps * share)
        out[view, y, x] = total
