"""Count of the pixels that an object covers alone, by the rule that gives a pixel its tag."""

import warp as wp

from ssad.rendering.camera.kernels.raster import LAST, NONE

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def cover(
    samples: wp.array3d(dtype=wp.uint64),
    shape: wp.array2d(dtype=int),
    scale: int,
    pixels: wp.array(dtype=int),
    hits: wp.array(dtype=int),
):
    """Count the pixels of the object and the covered samples in crop b, within shape[b] (rows, columns) pixels.

    As in shading, a pixel belongs to the triangle with most samples, and in a tie to the object before the sky.
    """
    crop, y, x = wp.tid()
    if y >= shape[crop, 0] or x >= shape[crop, 1]:
        return
    count = scale * scale
    sky_count = int(0)
    best_count = int(0)
    for sample in range(count):
        key = samples[crop, y * scale + sample / scale, x * scale + sample % scale] & LAST
        if key == NONE:
            sky_count += 1
        else:
            same_count = int(1)
            for next_sample in range(sample + 1, count):
                if (samples[crop, y * scale + next_sample / scale, x * scale + next_sample % scale] & LAST) == key:
                    same_count += 1
            best_count = wp.max(best_count, same_count)
    if sky_count < count:
        wp.atomic_add(hits, crop, count - sky_count)
        # A tie between object and sky counts for the object.
        if best_count >= sky_count:
            wp.atomic_add(pixels, crop, 1)
