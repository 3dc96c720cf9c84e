"""A code for each code: what changes every value alike."""

import warp as wp


@wp.kernel
def recode(
    image: wp.array(dtype=wp.uint32),
    table: wp.array2d(dtype=wp.uint8),
    words: int,
    chunk: int,
    out: wp.array(dtype=wp.uint32),
):
    """Every byte looked up in table[b], four at a time."""
    b, part = wp.tid()
    first = part * chunk
    last = wp.min(first + chunk, words)
    for i in range(b * words + first, b * words + last):
        word = image[i]
        low = wp.uint32(table[b, int(word & wp.uint32(255))])
        second = wp.uint32(table[b, int((word >> wp.uint32(8)) & wp.uint32(255))])
        third = wp.uint32(table[b, int((word >> wp.uint32(16)) & wp.uint32(255))])
        high = wp.uint32(table[b, int(word >> wp.uint32(24))])
        out[i] = low | (second << wp.uint32(8)) | (third << wp.uint32(16)) | (high << wp.uint32(24))
