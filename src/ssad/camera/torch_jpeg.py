"""JPEG in torch, with gradients: libjpeg's encoder and decoder.

Coefficients are those of libjpeg to the last bit, decoded values are within a few codes of its own (they differ by the
decoder's rounding). Rounding is done for real and has slope one (straight-through): the mean slope of a staircase, so
that what an optimiser sees is the picture that is recorded and how it changes over steps larger than a stair. Colours
cut off at black or white have slope zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from ssad.core.errors import ConfigError

# Annex K of the JPEG standard (ITU-T T.81), for quality 50
LUMINANCE = (
    (16, 11, 10, 16, 24, 40, 51, 61),
    (12, 12, 14, 19, 26, 58, 60, 55),
    (14, 13, 16, 24, 40, 57, 69, 56),
    (14, 17, 22, 29, 51, 87, 80, 62),
    (18, 22, 37, 56, 68, 109, 103, 77),
    (24, 35, 55, 64, 81, 104, 113, 92),
    (49, 64, 78, 87, 103, 121, 120, 101),
    (72, 92, 95, 98, 112, 100, 103, 99),
)
CHROMINANCE = (
    (17, 18, 24, 47, 99, 99, 99, 99),
    (18, 21, 26, 66, 99, 99, 99, 99),
    (24, 26, 56, 99, 99, 99, 99, 99),
    (47, 66, 99, 99, 99, 99, 99, 99),
    *(((99,) * 8,) * 4),
)
# libjpeg's 16-bit fixed-point weights of R, G, B in Y, Cb, Cr, and back
TO_YCBCR = ((19595, 38470, 7471), (-11059, -21709, 32768), (32768, -27439, -5329))
FROM_YCBCR = ((1.0, 0.0, 1.402), (1.0, -0.344136286, -0.714136286), (1.0, 1.772, 0.0))
ACCURATE = 96  # quality from which libjpeg-turbo takes the accurate DCT unless told
TIE = 2.0**-12  # so that halves go up in whatever order sums were made


def _straight(value: Tensor, rounded: Tensor) -> Tensor:
    """Exactly what is rounded, with the slope of the value (straight-through)."""
    return rounded.detach() + (value - value.detach())


def _nearest(value: Tensor) -> Tensor:
    """The nearest whole number, halves up, with slope one."""
    return _straight(value, torch.floor(value + (0.5 + TIE)))


def to_8_bits(image: Tensor) -> Tensor:
    """Rounds to the 256 codes of a file, with slope one inside 0..1 and zero outside.

    Args:
        image: Any shape, used in 0..1.

    Returns:
        Multiples of 1/255.
    """
    return _nearest(image.clamp(0.0, 1.0) * 255) / 255


def quantisation(quality: int) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the coefficients of luminance and chrominance: Annex K's tables, scaled as libjpeg does.

    Args:
        quality: 1 to 100.

    Returns:
        Two tables [8, 8] of 1..255, rows by vertical frequency.

    Raises:
        ConfigError: The quality is outside 1..100.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"a JPEG quality of {quality}: it must be in 1..100")
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    luminance, chrominance = (np.clip((np.array(t) * scale + 50) // 100, 1, 255) for t in (LUMINANCE, CHROMINANCE))
    return luminance, chrominance


@lru_cache(maxsize=1)
def _cosines() -> np.ndarray:
    """The orthonormal DCT-II [8, 8], a row for each frequency."""
    k = np.arange(8)
    rows = np.cos(np.pi * (2 * k + 1) * k[:, None] / 16) / 2
    rows[0] /= np.sqrt(2)
    return np.asarray(rows)


def _fast_pass(lines: Tensor) -> Tensor:
    """Fast DCT of libjpeg along the first axis of integers [8, ...], with 8-bit constants.

    By Arai, Agui and Nakajima. Each frequency comes out scaled by `_fast_divisors`.
    """
    a0, a1, a2, a3, a4, a5, a6, a7 = lines.unbind()
    s0, s1, s2, s3 = a0 + a7, a1 + a6, a2 + a5, a3 + a4
    d0, d1, d2, d3 = a0 - a7, a1 - a6, a2 - a5, a3 - a4
    even, odd, low = s0 + s3, s1 + s2, s0 - s3
    turned = (s1 - s2 + low) * 181 >> 8
    e0, e1, e2 = d3 + d2, d2 + d1, d1 + d0
    shared = (e0 - e2) * 98 >> 8
    f0, f2 = (e0 * 139 >> 8) + shared, (e2 * 334 >> 8) + shared
    f1 = e1 * 181 >> 8
    g0, g1 = d0 + f1, d0 - f1
    return torch.stack([even + odd, g0 + f2, low + turned, g1 - f0, even - odd, g1 + f0, low - turned, g0 - f2])


def _fast_divisors(table: np.ndarray) -> np.ndarray:
    """Steps [8, 8] in the scale of `_fast_pass`, rounded as libjpeg does."""
    scales = np.array([np.sqrt(2) * np.cos(k * np.pi / 16) if k else 1.0 for k in range(8)])
    return np.asarray(np.floor(table * np.rint(np.outer(scales, scales) * 2**14) / 2**11 + 0.5))


def _accurate_pass(lines: Tensor, *, first: bool) -> Tensor:
    """Accurate DCT of libjpeg along the first axis of integers [8, ...], with 13-bit constants.

    By Loeffler, Ligtenberg and Moschytz. The first pass keeps two extra bits and the second removes them: the result is
    in eighths.
    """
    a0, a1, a2, a3, a4, a5, a6, a7 = lines.unbind()
    s0, s1, s2, s3 = a0 + a7, a1 + a6, a2 + a5, a3 + a4
    d0, d1, d2, d3 = a0 - a7, a1 - a6, a2 - a5, a3 - a4
    even, odd, low, high = s0 + s3, s1 + s2, s0 - s3, s1 - s2
    turned = (high + low) * 4433
    shared = (d3 + d1 + d2 + d0) * 9633
    z1, z2 = (d3 + d0) * -7373, (d2 + d1) * -20995
    z3, z4 = (d3 + d1) * -16069 + shared, (d2 + d0) * -3196 + shared
    rows = [
        even + odd, d0 * 12299 + z1 + z4, turned + low * 6270, d1 * 25172 + z2 + z3,
        even - odd, d2 * 16819 + z2 + z4, turned - high * 15137, d3 * 2446 + z1 + z3,
    ]  # fmt: skip
    bits = 11 if first else 15
    for k in (1, 2, 3, 5, 6, 7):
        rows[k] = rows[k] + (1 << (bits - 1)) >> bits
    for k in (0, 4):
        rows[k] = rows[k] << 2 if first else rows[k] + 2 >> 2
    return torch.stack(rows)


def _steps(blocks: Tensor, table: np.ndarray, *, fast: bool) -> Tensor:
    """How many steps each coefficient of blocks [..., 8, 8] of whole numbers has, to libjpeg's last bit."""
    lines = blocks.movedim(-1, 0).to(torch.int32).contiguous()
    if fast:
        found, divisors = _fast_pass(_fast_pass(lines).movedim(-1, 0).contiguous()), _fast_divisors(table)
    else:
        once = _accurate_pass(lines, first=True).movedim(-1, 0).contiguous()
        found, divisors = _accurate_pass(once, first=False), 8 * table
    # vertical and horizontal frequency, blocks
    step = torch.as_tensor(divisors.astype(np.int32), device=blocks.device).reshape(8, 8, *[1] * (found.ndim - 2))
    whole = found.sign() * torch.div(found.abs() + step // 2, step, rounding_mode="floor")
    return whole.movedim((0, 1), (-2, -1)).to(blocks.dtype)


def _compress(plane: Tensor, table: np.ndarray, *, fast: bool) -> Tensor:
    """Whole codes [..., H, W], in whole blocks of 8 x 8, through quantisation and back."""
    cosines = torch.as_tensor(_cosines(), dtype=plane.dtype, device=plane.device)
    step = torch.as_tensor(table, dtype=plane.dtype, device=plane.device)
    height, width = plane.shape[-2:]
    blocks = plane.reshape(*plane.shape[:-2], height // 8, 8, width // 8, 8).transpose(-3, -2) - 128
    with torch.no_grad():
        whole = _steps(blocks, table, fast=fast)
    kept = _straight(cosines @ blocks @ cosines.T / step, whole) * step
    pixels = _nearest(cosines.T @ kept @ cosines + 128)
    return pixels.transpose(-3, -2).reshape(plane.shape).clamp(0, 255)


def _to_ycbcr(codes: Tensor) -> Tensor:
    """Whole Y, Cb and Cr of whole R, G and B [B, 3, H, W], to libjpeg's last bit."""
    weights = torch.tensor(TO_YCBCR, dtype=codes.dtype, device=codes.device) / 65536
    middle = torch.tensor([0.0, 128.0, 128.0], dtype=codes.dtype, device=codes.device).reshape(3, 1, 1)
    smooth = torch.einsum("ij,bjhw->bihw", weights, codes) + middle
    with torch.no_grad():
        red, green, blue = codes.to(torch.int32).unbind(1)
        halves = (32768, (128 << 16) + 32767, (128 << 16) + 32767)
        rows = [a * red + b * green + c * blue + half >> 16 for (a, b, c), half in zip(TO_YCBCR, halves, strict=True)]
        whole = torch.stack(rows, 1).to(codes.dtype)
    return _straight(smooth, whole)


def _halved(plane: Tensor) -> Tensor:
    """The mean of each 2 x 2; halves go down and up by turns along a row, as in libjpeg."""
    total = plane[..., ::2, ::2] + plane[..., ::2, 1::2] + plane[..., 1::2, ::2] + plane[..., 1::2, 1::2]
    bias = 1.0 + torch.arange(total.shape[-1], device=plane.device) % 2
    return _straight(total / 4, torch.floor((total + bias) / 4))


def _doubled(plane: Tensor) -> Tensor:
    """Twice the size by weights 3 : 1 along each side ("fancy upsampling"), with libjpeg's rounding."""
    wide = pad(plane, (1, 1, 1, 1), mode="replicate")
    middle = 3 * wide[..., 1:-1, :]
    rows = torch.stack([middle + wide[..., :-2, :], middle + wide[..., 2:, :]], -2).flatten(-3, -2)
    middle = 3 * rows[..., 1:-1]
    total = torch.stack([middle + rows[..., :-2], middle + rows[..., 2:]], -1)
    bias = torch.tensor([8.0, 7.0], dtype=plane.dtype, device=plane.device)
    return _straight(total / 16, torch.floor((total + bias) / 16)).flatten(-2)


def block_of(subsampling: str) -> int:
    """How large the unit is that is coded on its own.

    Args:
        subsampling: "420" or "444".

    Returns:
        Pixels along a side.

    Raises:
        ConfigError: There is no such subsampling.
    """
    if subsampling not in ("420", "444"):
        raise ConfigError(f'a chroma subsampling of {subsampling!r}: it must be "420" or "444"')
    return 16 if subsampling == "420" else 8


def extended(picture: Tensor, height: int, width: int) -> Tensor:
    """A picture with its last row and column repeated up to a size.

    Args:
        picture: [C, H, W].
        height: At least H.
        width: At least W.

    Returns:
        [C, height, width].
    """
    down, right = height - picture.shape[1], width - picture.shape[2]
    return pad(picture[None], (0, right, 0, down), mode="replicate")[0] if down or right else picture


def _repeated(planes: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """Planes [B, C, H, W] with what lies beyond sizes [B] replaced by the last row and column before."""
    whole = (int(planes.shape[2]), int(planes.shape[3]))
    if all(size == whole for size in sizes):
        return planes
    return torch.stack([extended(one[:, :h, :w], *whole) for one, (h, w) in zip(planes, sizes, strict=True)])


def compressed(
    image: Tensor, sizes: Sequence[tuple[int, int]], quality: int, subsampling: str, *, fast: bool
) -> Tensor:
    """`jpeg` of images that are whole blocks, such as parts of larger ones.

    Args:
        image: sRGB in [0, 1], [B, 3, H, W]; H and W are multiples of `block_of`.
        sizes: Height and width of each image, beyond which it repeats its last row and column.
        quality: 1 to 100.
        subsampling: "420" or "444".
        fast: Whether the encoder takes libjpeg's fast DCT.

    Returns:
        [B, 3, H, W], multiples of 1/255.

    Raises:
        ConfigError: There is no such quality.
    """
    luminance, chrominance = quantisation(quality)
    planes = _to_ycbcr(_nearest(image.clamp(0.0, 1.0) * 255))
    bright, colours = planes[:, :1], planes[:, 1:]
    if subsampling == "420":
        # what is not there repeats the last mean of two rows, and the last column; back from it, both repeat the last
        halves = [((height + 1) // 2, (width + 1) // 2) for height, width in sizes]
        colours = _halved(colours)
        colours = _repeated(colours, [(height, colours.shape[3]) for height, _ in halves])
        colours = _doubled(_repeated(_compress(colours, chrominance, fast=fast), halves))
    else:
        colours = _compress(colours, chrominance, fast=fast)
    back = torch.tensor(FROM_YCBCR, dtype=image.dtype, device=image.device)
    decoded = torch.cat([_compress(bright, luminance, fast=fast), colours - 128], 1)
    return _nearest(torch.einsum("ij,bjhw->bihw", back, decoded)).clamp(0, 255) / 255


def jpeg(image: Tensor, quality: int = 92, subsampling: str = "420", *, fast: bool | None = None) -> Tensor:
    """A picture after it was written as JPEG and read again, as libjpeg does both.

    Rounds to 8 bits, YCbCr, means of 2 x 2 of the colours where they are subsampled, DCT of 8 x 8, quantisation, and
    all of it back. Borders are repeated to whole blocks.

    Args:
        image: sRGB in [0, 1], [B, 3, H, W].
        quality: 1 to 100, as libjpeg scales it.
        subsampling: "420" or "444".
        fast: Whether the encoder takes libjpeg's fast DCT, which hits other steps where steps are small; None for what
            `ssad.core.images.encode_jpeg` (libjpeg-turbo's own choice) does: below 96. OpenCV and Pillow do not.

    Returns:
        Multiples of 1/255, shaped as image. Slope one through every rounding, zero where a value is cut off at black or
        white.

    Raises:
        ConfigError: A quality or subsampling that there is not.
    """
    block, (height, width) = block_of(subsampling), image.shape[2:]
    size = (-(-height // block) * block, -(-width // block) * block)
    whole = torch.stack([extended(one, *size) for one in image])
    fast = quality < ACCURATE if fast is None else fast
    return compressed(whole, [(height, width)] * len(image), quality, subsampling, fast=fast)[:, :, :height, :width]
