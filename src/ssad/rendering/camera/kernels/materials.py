"""Material of the surface that a pixel shows, by the rule that gives a pixel its tag."""

import warp as wp

from ssad.rendering.camera.kernels.raster import LAST, NONE
from ssad.rendering.camera.kernels.shade import DrawRanges, Geometry

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def find_materials(
    geometry: Geometry,
    draw_samples: DrawRanges,
    scale: int,
    tags: wp.array3d(dtype=int),
    materials: wp.array3d(dtype=int),
):
    """Write the material of the face with most samples of the pixel's tag; -1 for the sky."""
    view, y, x = wp.tid()
    count = scale * scale
    best_count = int(0)
    material = int(-1)
    for sample in range(count):
        key = draw_samples.samples[view, y * scale + sample / scale, x * scale + sample % scale] & LAST
        if key != NONE:
            owner = draw_samples.owners[int(LAST - key) / 2]
            if draw_samples.tags[owner[0]] == tags[view, y, x]:
                same_count = int(1)
                for next_sample in range(sample + 1, count):
                    row = y * scale + next_sample / scale
                    column = x * scale + next_sample % scale
                    if (draw_samples.samples[view, row, column] & LAST) == key:
                        same_count += 1
                if same_count > best_count:
                    best_count = same_count
                    material = geometry.material[owner[1]]
    materials[view, y, x] = material
