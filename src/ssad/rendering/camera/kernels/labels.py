"""How many pixels a thing covers when nothing else is there, by the rule that gives a pixel its tag."""

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
    """Counts in view b, within its first shape[b] (rows, columns) pixels: pixels of the thing, and covered samples.

    As in shading, a pixel belongs to the triangle with most samples, and to the thing before the sky in a tie.
    """
    b, y, x = wp.tid()
    if y >= shape[b, 0] or x >= shape[b, 1]:
        return
    count = scale * scale
    sky = int(0)
    best = int(0)
    for s in range(count):
        key = samples[b, y * scale + s / scale, x * scale + s % scale] & LAST
        if key == NONE:
            sky += 1
        else:
            same = int(1)
            for e in range(s + 1, count):
                if (samples[b, y * scale + e / scale, x * scale + e % scale] & LAST) == key:
                    same += 1
            best = wp.max(best, same)
    if sky < count:
        wp.atomic_add(hits, b, count - sky)
        if best >= sky:
            wp.atomic_add(pixels, b, 1)
