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
    sample_share = 1.0 / float(scale * scale)
    # Neighbours mostly show the same surface: what is no lamp is looked up once.
    dark_key = wp.uint64(0)
    for x in range(lane, out.shape[2], lanes):
        glow_light = wp.vec3(0.0, 0.0, 0.0)
        if is_glowing[view] == 1 and light.lamps > 0.0:
            for sample in range(scale * scale):
                sample_row = y * scale + sample / scale
                sample_column = x * scale + sample % scale
                sample_key = draw_samples.samples[view, sample_row, sample_column] & LAST
                if sample_key != dark_key:
                    owner_slot = int(LAST - sample_key)
                    draw_and_face = draw_samples.owners[owner_slot / 2]
                    lamp_gain = gains[geometry.material[draw_and_face[1]]]
                    if lamp_gain <= 0.0:
                        dark_key = sample_key
                    else:
                        view_lens = lens[view]
                        image_column = (float(sample_column) + 0.5) / float(scale) - 0.5
                        image_row = (float(sample_row) + 0.5) / float(scale) - 0.5
                        sample_ray = wp.vec3(
                            (image_column - view_lens[2]) / view_lens[0], (image_row - view_lens[3]) / view_lens[1], 1.0
                        )
                        surface_hit = hit_of(geometry, draw_samples, owner_slot, sample_ray, to_world[view])
                        surface = geometry.surfaces[geometry.material[draw_and_face[1]]]
                        to_camera = draw_samples.matrices[draw_and_face[0]]
                        leftward = wp.vec3(to_camera[0, 1], to_camera[1, 1], to_camera[2, 1])
                        middle = wp.vec3(to_camera[0, 3], to_camera[1, 3], to_camera[2, 3])
                        distance_aside = wp.dot(leftward, sample_ray * surface_hit.z - middle)
                        lamp_state = draw_samples.lit[draw_and_face[0]]
                        emission = lamp_emission(
                            surface, lamp_state, distance_aside, draw_samples.split[draw_and_face[0]], light.lamps
                        )
                        clearness = air_transmission(light, surface_hit.distance)
                        glow_light = glow_light + wp.cw_mul(emission, clearness) * (
                            lamp_gain * light.lamps * sample_share
                        )
        out[view, y, x] = glow_light
