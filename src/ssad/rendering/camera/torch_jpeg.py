"""JPEG in torch, with gradients: libjpeg's encoder and decoder.

Coefficients equal those of libjpeg to the last bit, decoded values are within a few codes of it (they differ by the
decoder's rounding). Rounding is exact in the forward pass and has slope one (straight-through): the mean slope of a
staircase. So an optimiser sees the recorded image, and how it changes over steps larger than a stair. Colours cut off
at black or white have slope zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate, pad

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
ACCURATE = 96  # quality from which libjpeg-turbo uses the accurate DCT by default
TIE = 2.0**-12  # makes halves round up whatever the order of the sums


def _straight_through(value: Tensor, rounded: Tensor) -> Tensor:
    """Return the rounded value with the slope of the value (straight-through)."""
    return rounded.detach() + (value - value.detach())


def _nearest(value: Tensor) -> Tensor:
    """Round to the nearest whole number, halves up, with slope one."""
    return _straight_through(value, torch.floor(value + (0.5 + TIE)))


def to_8_bits(image: Tensor) -> Tensor:
    """Round to the 256 codes of a file, with slope one inside 0..1 and zero outside.

    Args:
        image: Any shape, used in 0..1.

    Returns:
        Multiples of 1/255.
    """
    return _nearest(image.clamp(0.0, 1.0) * 255) / 255


def quantisation(quality: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the quantisation steps of luminance and chrominance: Annex K's tables, scaled as in libjpeg.

    Args:
        quality: 1 to 100.

    Returns:
        Two tables [8, 8] of 1..255, rows by vertical frequency.

    Raises:
        ConfigError: The quality is outside 1..100.
    """
    if not 1 <= quality <= 100:
        raise ConfigError(f"a JPEG quality of {quality}: it must be in 1..100")
    # libjpeg's scale in percent: 100 at quality 50.
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    luminance, chrominance = (
        np.clip((np.array(table) * scale + 50) // 100, 1, 255) for table in (LUMINANCE, CHROMINANCE)
    )
    return luminance, chrominance


@dataclass(frozen=True, slots=True)
class _CosinePass:
    """One-dimensional integer DCT of libjpeg, applied exactly to columns [8, N] of whole numbers.

    Attributes:
        inner: [K, 8]; weights of the input in terms that are rounded down before use.
        direct: [8, 8]; weights of the input in each output.
        taken: [8, K]; weights of the rounded terms in each output.
        bias: [8, 1]; added before outputs are rounded down.
    """

    inner: Tensor
    direct: Tensor
    input_rows: Tensor
    bias: Tensor

    def __call__(self, columns: Tensor) -> Tensor:
        """Return the frequencies [8, N]."""
        if not len(self.inner):
            return torch.floor(torch.addmm(self.bias, self.direct, columns))
        return torch.addmm(self.direct @ columns, self.input_rows, torch.floor(self.inner @ columns))


@dataclass(frozen=True, slots=True)
class _Code:
    """Conversion of blocks to quantisation steps and back to pixels, in `_exact`.

    Attributes:
        passes: Along rows and along columns of a block.
        divisors: What a coefficient of luminance and one of chrominance are divided by [64, 2], rows before columns.
        steps: What a step of each is worth [64, 2].
        pixels: From coefficients to the pixels of a block [64, 64].
    """

    passes: tuple[_CosinePass, _CosinePass]
    divisors: Tensor
    steps: Tensor
    pixels: Tensor


def _fast_pass() -> list[np.ndarray]:
    """Fast DCT of libjpeg with 8-bit constants, as the matrices of `_CosinePass`.

    By Arai, Agui and Nakajama. Each frequency comes out scaled by `_fast_divisors`.
    """
    unit = np.eye(13)
    samples, (turned, shared, t0, t2, f1) = unit[:8], unit[8:]
    sums, differences = samples[:4] + samples[7:3:-1], samples[:4] - samples[7:3:-1]
    even, odd, low = sums[0] + sums[3], sums[1] + sums[2], sums[0] - sums[3]
    e0, e1, e2 = differences[3] + differences[2], differences[2] + differences[1], differences[1] + differences[0]
    inner = [(sums[1] - sums[2] + low) * 181, (e0 - e2) * 98, e0 * 139, e2 * 334, e1 * 181]
    f0, f2, g0, g1 = t0 + shared, t2 + shared, differences[0] + f1, differences[0] - f1
    rows = np.stack([even + odd, g0 + f2, low + turned, g1 - f0, even - odd, g1 + f0, low - turned, g0 - f2])
    return [np.stack(inner)[:, :8] / 256, rows[:, :8], rows[:, 8:], np.zeros((8, 1))]


def _fast_divisors(table: np.ndarray) -> np.ndarray:
    """Return the steps [8, 8] in the scale of `_fast_pass`, rounded as in libjpeg."""
    scales = np.array([np.sqrt(2) * np.cos(frequency * np.pi / 16) if frequency else 1.0 for frequency in range(8)])
    return np.asarray(np.floor(table * np.rint(np.outer(scales, scales) * 2**14) / 2**11 + 0.5))


def _accurate_pass(*, first: bool) -> list[np.ndarray]:
    """Accurate DCT of libjpeg with 13-bit constants, as the matrices of `_CosinePass`.

    By Loeffler, Ligtenberg and Moschytz. The first pass keeps two extra bits and the second removes them: the result is
    in eighths.
    """
    samples = np.eye(8)
    sums, differences = samples[:4] + samples[7:3:-1], samples[:4] - samples[7:3:-1]
    even, odd, low, high = sums[0] + sums[3], sums[1] + sums[2], sums[0] - sums[3], sums[1] - sums[2]
    turned = (high + low) * 4433
    shared = (differences[3] + differences[1] + differences[2] + differences[0]) * 9633
    z1, z2 = (differences[3] + differences[0]) * -7373, (differences[2] + differences[1]) * -20995
    z3, z4 = (differences[3] + differences[1]) * -16069 + shared, (differences[2] + differences[0]) * -3196 + shared
    rows = np.stack(
        [
            even + odd,
            differences[0] * 12299 + z1 + z4,
            turned + low * 6270,
            differences[1] * 25172 + z2 + z3,
            even - odd,
            differences[2] * 16819 + z2 + z4,
            turned - high * 15137,
            differences[3] * 2446 + z1 + z3,
        ]
    )
    bits = np.array([-2 if first else 2, *[11 if first else 15] * 3] * 2, float)[:, None]
    bias = np.where(bits > 0, 0.5, 0.0)
    return [np.zeros((0, 8)), rows / 2**bits, np.zeros((8, 0)), bias]


def _exact(device: torch.device, *, fast: bool) -> torch.dtype:
    """Return the type in which all whole numbers of an encoder are exact.

    Those of the fast DCT and of colours stay below 2^24, which float32 holds. A GPU may compute float32
    products with fewer bits, so it always gets float64.
    """
    return torch.float32 if fast and device.type == "cpu" else torch.float64


@lru_cache(maxsize=16)
def _code(quality: int, device: torch.device, *, fast: bool) -> _Code:
    """Return the coder of a quality, cached per device: small copies to a GPU cost more than the coding itself."""

    def to_device(values: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(values), dtype=_exact(device, fast=fast), device=device)

    tables = np.stack(quantisation(quality), -1).astype(np.float64)  # vertical and horizontal frequency, plane
    if fast:
        passes = [_fast_pass()] * 2
        divisors = np.stack([_fast_divisors(tables[..., index]) for index in range(2)], -1)
    else:
        passes, divisors = [_accurate_pass(first=True), _accurate_pass(first=False)], 8 * tables
    index = np.arange(8)
    cosines = (
        np.cos(np.pi * (2 * index + 1) * index[:, None] / 16) / 2
    )  # the orthonormal DCT-II, a row for each frequency
    cosines[0] /= np.sqrt(2)
    with torch.inference_mode(mode=False):
        row_pass, column_pass = (_CosinePass(*map(to_device, matrices)) for matrices in passes)
        inverse = to_device(np.kron(cosines.T, cosines.T))
        return _Code(
            (row_pass, column_pass), to_device(divisors.reshape(64, 2)), to_device(tables.reshape(64, 2)), inverse
        )


def _quantise_planes(bright: Tensor, colours: Tensor, quality: int, *, fast: bool) -> tuple[Tensor, Tensor]:
    """Planes [B, C, H, W] of whole codes, in whole blocks of 8 x 8, through quantisation and back; not cut off.

    Args:
        bright: Luminance.
        colours: Chrominance, of the same or another size.
        quality: Of JPEG.
        fast: Whether the encoder takes the fast DCT.
    """
    coder, planes = _code(quality, bright.device, fast=fast), (bright, colours)
    block_planes = [
        plane.reshape(*plane.shape[:2], plane.shape[2] // 8, 8, -1, 8).permute(5, 3, 0, 1, 2, 4) for plane in planes
    ]
    block_counts = [plane.numel() // 64 for plane in planes]
    columns = (
        torch.cat([block_plane.reshape(8, 8, -1) for block_plane in block_planes], 2).to(coder.steps.dtype) - 128.0
    )
    row_pass, column_pass = coder.passes
    row_frequencies = row_pass(columns.flatten(1)).reshape(8, 8, -1).transpose(0, 1)  # horizontal frequency, now second
    coefficients = column_pass(row_frequencies.reshape(8, -1)).reshape(64, -1)  # vertical, then horizontal frequency

    def per_column(table: Tensor) -> Tensor:
        return torch.cat(
            [
                table[:, plane_index : plane_index + 1].expand(64, block_count)
                for plane_index, block_count in enumerate(block_counts)
            ],
            1,
        )

    divisors = per_column(coder.divisors)
    steps = torch.floor((coefficients.abs() + torch.floor(divisors / 2)) / divisors).copysign(coefficients)
    pixels = torch.floor(coder.pixels @ (steps * per_column(coder.steps)) + (128.5 + TIE)).to(bright.dtype)
    decoded = []
    for plane, plane_pixels in zip(planes, torch.split(pixels, block_counts, 1), strict=True):
        batch_size, channels, height, width = plane.shape
        blocks = plane_pixels.reshape(8, 8, batch_size, channels, height // 8, width // 8)
        decoded.append(blocks.permute(2, 3, 4, 0, 5, 1).reshape(plane.shape))
    return decoded[0], decoded[1]


@lru_cache(maxsize=8)
def _colour_weights(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Return the weights of colour conversion.

    R, G, B to Y, Cb, Cr [3, 3]; the terms added before rounding down [3, 1, 1]; and the way back [3, 3].
    """
    halves = torch.tensor([32768, (128 << 16) + 32767, (128 << 16) + 32767], dtype=torch.float64) / 65536
    with torch.inference_mode(mode=False):
        to_ycbcr = torch.tensor(TO_YCBCR, dtype=dtype, device=device) / 65536
        return to_ycbcr, halves.to(device, dtype).reshape(3, 1, 1), torch.tensor(FROM_YCBCR, dtype=dtype, device=device)


def _mix_planes(weights: Tensor, planes: Tensor) -> Tensor:
    """Mix planes [B, 3, H, W] linearly."""
    return torch.einsum("ij,bjhw->bihw", weights, planes)


@lru_cache(maxsize=32)
def _alternating_row(first: float, second: float, count: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return two alternating numbers along a row [W]."""
    with torch.inference_mode(mode=False):
        return torch.tensor([first, second], dtype=dtype, device=device).repeat(-(-count // 2))[:count]


def _halve(plane: Tensor) -> Tensor:
    """Average each 2 x 2 whole codes; halves go down and up alternately along a row, as in libjpeg."""
    mean = avg_pool2d(plane, 2)
    return torch.floor(mean + _alternating_row(0.25, 0.5, mean.shape[-1], plane.device, plane.dtype))


def _double(plane: Tensor) -> Tensor:
    """Double the size by weights 3 : 1 along each side ("fancy upsampling"), with libjpeg's rounding."""
    # Bilinear interpolation has exactly these weights.
    interpolated = _widen(plane)
    return torch.floor(
        interpolated + _alternating_row(8 / 16, 7 / 16, interpolated.shape[-1], plane.device, plane.dtype)
    )


def _widen(plane: Tensor) -> Tensor:
    return interpolate(plane, scale_factor=2, mode="bilinear", align_corners=False)


def block_of(subsampling: str) -> int:
    """Return the side of the unit that is coded independently.

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


def extend_border(image: Tensor, height: int, width: int) -> Tensor:
    """A picture with its last row and column repeated up to a size.

    Args:
        image: [C, H, W].
        height: At least H.
        width: At least W.

    Returns:
        [C, height, width].
    """
    down, right = height - image.shape[1], width - image.shape[2]
    return pad(image[None], (0, right, 0, down), mode="replicate")[0] if down or right else image


def _repeat_border(planes: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """Replace everything in planes [B, C, H, W] beyond sizes [B] by the last row and column inside."""
    full_size = (int(planes.shape[2]), int(planes.shape[3]))
    if all(size == full_size for size in sizes):
        return planes
    return torch.stack(
        [
            extend_border(plane[:, :height, :width], *full_size)
            for plane, (height, width) in zip(planes, sizes, strict=True)
        ]
    )


def compress(image: Tensor, sizes: Sequence[tuple[int, int]], quality: int, subsampling: str, *, fast: bool) -> Tensor:
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
    quantisation(quality)
    half_sizes = [((height + 1) // 2, (width + 1) // 2) for height, width in sizes]
    is_subsampled = subsampling == "420"
    image = image.clamp(0.0, 1.0)
    with torch.no_grad():
        exact_type = _exact(image.device, fast=True)
        to_ycbcr, rounding, _ = _colour_weights(image.device, exact_type)
        codes = torch.floor(image * 255 + (0.5 + TIE)).to(exact_type)
        planes = torch.floor(_mix_planes(to_ycbcr, codes) + rounding).to(image.dtype)
        luminance, chrominance = planes[:, :1], planes[:, 1:]
        if is_subsampled:
            # what is not there repeats the last mean of two rows, and the last column; back from it, both repeat the
            # after decoding.
            chrominance = _halve(chrominance)
            chrominance = _repeat_border(chrominance, [(height, chrominance.shape[3]) for height, _ in half_sizes])
        luminance, chrominance = _quantise_planes(luminance, chrominance, quality, fast=fast)
        unclipped = (luminance > 0) & (luminance < 255), (chrominance > 0) & (chrominance < 255)
        luminance, chrominance = luminance.clamp(0, 255), chrominance.clamp(0, 255)
        if is_subsampled:
            chrominance = _double(_repeat_border(chrominance, half_sizes))
        to_ycbcr, _, from_ycbcr = _colour_weights(image.device, image.dtype)
        codes = torch.floor(_mix_planes(from_ycbcr, torch.cat([luminance, chrominance - 128], 1)) + (0.5 + TIE))
        is_unclipped = (codes > 0) & (codes < 255)
        codes = codes.clamp(0, 255) / 255
    if not image.requires_grad:
        return codes
    # Without rounding, coding is the identity: the means of the colours and the clipping remain.
    planes = _mix_planes(to_ycbcr, image)
    luminance, chrominance = planes[:, :1] * unclipped[0], planes[:, 1:]
    chrominance = (
        _widen(_repeat_border(avg_pool2d(chrominance, 2) * unclipped[1], half_sizes))
        if is_subsampled
        else chrominance * unclipped[1]
    )
    return _straight_through(_mix_planes(from_ycbcr, torch.cat([luminance, chrominance], 1)) * is_unclipped, codes)


def jpeg(image: Tensor, quality: int = 92, subsampling: str = "420", *, fast: bool | None = None) -> Tensor:
    """Encode an image as JPEG and decode it, both as libjpeg does.

    Rounds to 8 bits, converts to YCbCr, averages 2 x 2 colours where they are subsampled, applies the 8 x 8 DCT
    and quantises, and reverses all of it. Borders are repeated to whole blocks.

    Args:
        image: sRGB in [0, 1], [B, 3, H, W].
        quality: 1 to 100, as libjpeg scales it.
        subsampling: "420" or "444".
        fast: Whether the encoder uses libjpeg's fast DCT, which gives other steps where steps are small; None
            for the choice of `ssad.core.images.encode_jpeg` (libjpeg-turbo's default): below 96. OpenCV and
            Pillow do not use it.

    Returns:
        Multiples of 1/255, shaped as image. Slope one through every rounding, zero where a value is cut off at
        black or white.

    Raises:
        ConfigError: Quality or subsampling is invalid.
    """
    block_pixels, (height, width) = block_of(subsampling), image.shape[2:]
    padded_size = (-(-height // block_pixels) * block_pixels, -(-width // block_pixels) * block_pixels)
    padded = torch.stack([extend_border(entry, *padded_size) for entry in image])
    fast = quality < ACCURATE if fast is None else fast
    return compress(padded, [(height, width)] * len(image), quality, subsampling, fast=fast)[:, :, :height, :width]
