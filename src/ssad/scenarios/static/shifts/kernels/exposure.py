"""Lookup of a new code for each code: for shifts that change every value in the same way."""

import warp as wp

wp.set_module_options({"enable_backward": False})  # nothing differentiates a shift: half the compilation


@wp.kernel
def recode(
    image: wp.array(dtype=wp.uint32),
    table: wp.array2d(dtype=wp.uint8),
    words: int,
    chunk: int,
    out: wp.array(dtype=wp.uint32),
):
    """Look up every byte in table[b], four at a time."""
    b, chunk_index = wp.tid()
    begin = chunk_index * chunk
    end = wp.min(begin + chunk, words)
    for i in range(b * words + begin, b * words + end):
        word = image[i]
        low = wp.uint32(table[b, int(word & wp.uint32(255))])
        second = wp.uint32(table[b, int((word >> wp.uint32(8)) & wp.uint32(255))])
        third = wp.uint32(table[b, int((word >> wp.uint32(16)) & wp.uint32(255))])
        high = wp.uint32(table[b, int(word >> wp.uint32(24))])
        out[i] = low | (second << wp.uint32(8)) | (third << wp.uint32(16)) | (high << wp.uint32(24))
