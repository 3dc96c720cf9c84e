"""Sensor noise: four bytes at a time, each from 16 bits of one hash of (key, word index)."""

import warp as wp

from ssad.scenarios.static.shifts.kernels.shared import draw

wp.set_module_options({"enable_backward": False})  # see `exposure`


@wp.func
def add_clipped(value: wp.uint32, noise: wp.int16) -> wp.uint32:
    """Return a byte plus noise, clipped."""
    return wp.uint32(wp.clamp(int(value) + int(noise), 0, 255))


@wp.func
def quarter(bits: wp.uint64, shift: int) -> int:
    """Return 16 of 64 bits as an index."""
    return int((bits >> wp.uint64(shift)) & wp.uint64(65535))


@wp.kernel
def add_noise(
    image: wp.array(dtype=wp.uint32),
    keys: wp.array(dtype=wp.uint64),
    table: wp.array2d(dtype=wp.int16),
    words: int,
    chunk: int,
    out: wp.array(dtype=wp.uint32),
):
    """Add table[b, u] for a uniform 16-bit u to every byte; the table is the inverse distribution function."""
    b, chunk_index = wp.tid()
    key = keys[b]
    begin = chunk_index * chunk
    end = wp.min(begin + chunk, words)
    image_start = b * words
    for i in range(begin, end):
        bits = draw(key, i)
        word = image[image_start + i]
        low = add_clipped(word & wp.uint32(255), table[b, quarter(bits, 0)])
        second = add_clipped((word >> wp.uint32(8)) & wp.uint32(255), table[b, quarter(bits, 16)])
        third = add_clipped((word >> wp.uint32(16)) & wp.uint32(255), table[b, quarter(bits, 32)])
        high = add_clipped(word >> wp.uint32(24), table[b, quarter(bits, 48)])
        out[image_start + i] = low | (second << wp.uint32(8)) | (third << wp.uint32(16)) | (high << wp.uint32(24))


@wp.func
def apply_impulse(value: wp.uint32, fresh: int, fixed: int, rate: int, fixed_rate: int) -> wp.uint32:
    """Return a byte, or 0 or 255 where one of two draws is below its rate (of 65536)."""
    result = value
    if fixed < fixed_rate:
        result = wp.uint32((fixed & 1) * 255)
    if fresh < rate:
        result = wp.uint32((fresh & 1) * 255)
    return result


@wp.kernel
def add_impulses(
    image: wp.array(dtype=wp.uint32),
    keys: wp.array(dtype=wp.uint64),
    fixed_keys: wp.array(dtype=wp.uint64),
    rates: wp.array(dtype=int),
    fixed_rates: wp.array(dtype=int),
    words: int,
    chunk: int,
    out: wp.array(dtype=wp.uint32),
):
    """Add salt and pepper: at new sites in every image, and at fixed sites of a camera (stuck pixels)."""
    b, chunk_index = wp.tid()
    begin = chunk_index * chunk
    end = wp.min(begin + chunk, words)
    image_start = b * words
    rate = rates[b]
    fixed_rate = fixed_rates[b]
    for i in range(begin, end):
        fresh_bits = draw(keys[b], i)
        fixed_bits = draw(fixed_keys[b], i)
        word = image[image_start + i]
        result = wp.uint32(0)
        for byte_index in range(4):
            value = (word >> wp.uint32(8 * byte_index)) & wp.uint32(255)
            value = apply_impulse(
                value, quarter(fresh_bits, 16 * byte_index), quarter(fixed_bits, 16 * byte_index), rate, fixed_rate
            )
            result = result | (value << wp.uint32(8 * byte_index))
        out[image_start + i] = result
