"""Image files of every supported format: the reader that returns upright pixels, and the writer of changed ones.

Formats are told by content, never by the name of the file: JPEG (baseline and progressive), PNG, TIFF, BMP, WebP and
PNM; grey, RGB, palette and CMYK; 8 or 16 bits a channel, with or without alpha.
"""

from __future__ import annotations

import contextlib
import io
import re
import struct
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from ssad.core.errors import FormatError
from ssad.core.safeio import MIB, read_bytes
from ssad.core.types import U8

if TYPE_CHECKING:
    from PIL import Image

MAX_FILE_BYTES: Final = 256 * MIB
MAX_PIXELS: Final = 1 << 26
FORMATS: Final = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM")
FORMAT_NAMES: Final = "JPEG, PNG, TIFF, BMP, WebP or PNM"
GREY_NOTE, ALPHA_NOTE = "greyscale repeated to three channels", "alpha left out"
# what begins as an image does, also of formats that are not read, so that none of them passes for another kind of file
_SIGNATURES: Final = (
    re.compile(rb"\xff\xd8\xff"),  # JPEG
    re.compile(rb"\x89PNG\r\n\x1a\n"),
    re.compile(rb"GIF8[79]a"),
    re.compile(rb"II\*\0|MM\0\*|II\+\0|MM\0\+"),  # TIFF, BigTIFF and most raw files of cameras
    re.compile(rb"RIFF....(WEBP|AVI )", re.DOTALL),
    re.compile(rb"BM.{4}\0\0\0\0", re.DOTALL),
    re.compile(rb"P[4-6]\s+(#[^\n]*\n\s*)*\d+\s"),  # binary PNM; a line of text may begin like the other kind
    re.compile(rb"\0\0\0.ftyp|\x1aE\xdf\xa3", re.DOTALL),  # HEIC, AVIF, MP4; Matroska and WebM
    re.compile(rb"\0\0\0\x0cjP  \r\n\x87\n|\xff\x4f\xff\x51|\0\0\0\x0cJXL "),  # JPEG 2000, JPEG XL
    re.compile(rb"8BPS|\x76\x2f\x31\x01|#\?RADIANCE"),  # Photoshop, OpenEXR, Radiance
)
SUFFIXES: Final = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".apng", ".tif", ".tiff", ".bmp", ".dib", ".webp"),
    *(".pbm", ".pgm", ".ppm", ".pnm"),
)
_OTHER_SUFFIXES: Final = (
    *(".gif", ".heic", ".heif", ".avif", ".jp2", ".j2k", ".jpx", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw"),
    *(".exr", ".hdr", ".tga", ".pcx", ".psd", ".ico", ".pam", ".pfm", ".qoi", ".ppm.gz"),
    *(".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".wmv"),
)
_ORIENTATION: Final = 0x0112  # EXIF tag
_BITS_PER_SAMPLE: Final = 0x0102  # TIFF tag
_PLANAR: Final = 0x011C  # TIFF tag
_JPEG: Final = b"\xff\xd8\xff"
_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_BLOCKS: Final = len(_PNG) + 25  # offset behind the header block of a PNG


@dataclass(frozen=True, slots=True)
class ImageFile:
    """The content of an image file.

    Attributes:
        pixels: [H, W, C] uint8 or uint16, upright; C is 1 (grey) or 3 (RGB).
        alpha: [H, W] of the same type, upright; None without alpha.
        format: One of `FORMATS`.
        orientation: EXIF orientation of the stored pixels, 1 (upright) to 8.
        model: Colour model that the file stores: "grey", "RGB" or "CMYK".
        lossless: Whether a WebP stores exact pixels; True for other formats but JPEG.
        frames: Number of frames or pages; the first was read.
        name: Name of the file for messages.
    """

    pixels: npt.NDArray[Any]
    alpha: npt.NDArray[Any] | None
    format: str
    orientation: int
    model: str
    lossless: bool
    frames: int
    name: str

    @property
    def rgb(self) -> U8:
        """The upright pixels as uint8 [H, W, 3]; 16 bits are rounded to 8, grey is repeated."""
        pixels = to_8_bits(self.pixels)
        # Not `broadcast_to`, whose result is read-only: images are drawn on and handed to torch.
        return np.ascontiguousarray(pixels) if pixels.shape[2] == 3 else np.repeat(pixels, 3, axis=2)

    @property
    def has_16_bits(self) -> bool:
        """True if a channel has 16 bits."""
        return self.pixels.dtype == np.uint16

    @property
    def notes(self) -> tuple[str, ...]:
        """Conversions that a user may want to know about."""
        notes = []
        if self.orientation != 1:
            notes.append(f"turned upright (EXIF orientation {self.orientation})")
        if self.model == "CMYK":
            notes.append("CMYK converted to RGB without a colour profile")
        if self.frames > 1:
            notes.append(f"the first of {self.frames} frames")
        if self.alpha is not None:
            notes.append(ALPHA_NOTE)
        return tuple(notes)


def read_image_file(path: str | Path) -> ImageFile:
    """Read an image file.

    Raises:
        FormatError: The file is missing, cut short, broken, too large, or not of a supported format.
    """
    return decode_image_file(read_bytes(path, limit=MAX_FILE_BYTES), str(path))


def decode_image_file(data: bytes, name: str = "<image>") -> ImageFile:
    """The same from the bytes of a file; `name` is what errors call it."""
    from PIL import ImageOps

    if not data:
        raise FormatError(f"{name}: not a {FORMAT_NAMES} image (the file is empty)")
    if data.startswith(_PNG):
        _check_png(data, name)
    with _opened(data, name) as image_file:
        if image_file.width * image_file.height > MAX_PIXELS:
            size = f"{image_file.width} x {image_file.height}"
            raise FormatError(f"{name}: {size} pixels are more than the limit of {MAX_PIXELS}")
        file_format = "JPEG" if image_file.format == "MPO" else str(image_file.format)
        orientation = image_file.getexif().get(_ORIENTATION, 1)
        orientation = orientation if orientation in range(1, 9) else 1
        # The second image of a JPEG is a preview or a gain map of the first.
        frames = 1 if file_format == "JPEG" else int(getattr(image_file, "n_frames", 1))
        lossless = file_format != "JPEG" and (file_format != "WEBP" or b"VP8L" in data[12:64])
        model = {"1": "grey", "L": "grey", "LA": "grey", "La": "grey", "I": "grey", "CMYK": "CMYK"}.get(
            image_file.mode, "grey" if image_file.mode.startswith("I;16") else "RGB"
        )
        if file_format == "PNG" and data[25] in (0, 4):  # colour type of the header block; Pillow shows grey as colours
            model = "grey"
        if file_format == "JPEG" and image_file.mode in ("L", "RGB"):
            # Strict: a file that is cut short raises.
            stored = simplejpeg.decode_jpeg(data, "GRAY" if image_file.mode == "L" else "RGB")
            pixels = turn_upright(stored, orientation)
            return ImageFile(pixels, None, file_format, orientation, model, lossless, frames, name)
        has_16_bits = _has_16_bits(image_file, data)
        if has_16_bits and _has_planes(image_file):
            # OpenCV reads them as if their channels were interleaved.
            raise FormatError(f"{name}: 16 bits a channel in separate planes are not supported; save it as PNG")
        if not has_16_bits:
            image_file.load()
            # Pillow turns a TIFF when it loads it.
            upright = np.array(_plain_mode(ImageOps.exif_transpose(image_file), name))
    if has_16_bits:
        # OpenCV turns a TIFF too, and no other file.
        upright = _decode_16_bits(data, name, file_format)
        upright = upright if file_format == "TIFF" else turn_upright(upright, orientation)
    pixels = upright[..., None] if upright.ndim == 2 else upright
    alpha = pixels[..., -1] if pixels.shape[2] in (2, 4) else None
    colours = np.ascontiguousarray(pixels[..., : 1 if pixels.shape[2] < 3 else 3])
    if model == "grey" and colours.shape[2] == 3:  # OpenCV returns grey with alpha as colours
        colours = np.ascontiguousarray(colours[..., :1])
    return ImageFile(colours, alpha, file_format, orientation, model, lossless, frames, name)


@contextlib.contextmanager
def _opened(data: bytes, name: str) -> Iterator[Image.Image]:
    """Open an image with Pillow; every error of reading it becomes a FormatError."""
    from PIL import Image, UnidentifiedImageError

    try:
        # Pillow warns of broken EXIF, which matters for the orientation only, and of sizes below our own limit.
        with (
            warnings.catch_warnings(action="ignore"),
            Image.open(io.BytesIO(data), formats=FORMATS) as image_file,
        ):
            yield image_file
    except FormatError:
        raise
    except UnidentifiedImageError:
        if data.startswith(_JPEG):
            raise FormatError(f"{name}: a broken or truncated JPEG: its header is incomplete") from None
        raise FormatError(f"{name}: not a {FORMAT_NAMES} image, or cut short at its beginning") from None
    except Image.DecompressionBombError:
        raise FormatError(f"{name}: more pixels than the limit of {MAX_PIXELS}") from None
    except Exception as error:  # Pillow and simplejpeg raise many kinds for broken bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        kind = "JPEG" if data.startswith(_JPEG) else "image"
        raise FormatError(f"{name}: a broken or truncated {kind}: {reason}") from None


def _check_png(data: bytes, name: str) -> None:
    """Check the end and the checksum of every block, which decoders skip: they fill what is missing with grey."""
    position, has_end = len(_PNG), False
    while position + 12 <= len(data) and not has_end:
        chunk_size = int.from_bytes(data[position : position + 4], "big")
        chunk_type, chunk_end = data[position + 4 : position + 8], position + 12 + chunk_size
        if chunk_end > len(data):
            break
        if zlib.crc32(data[position + 4 : chunk_end - 4]) != int.from_bytes(data[chunk_end - 4 : chunk_end], "big"):
            block = ascii(chunk_type.decode("latin-1"))
            raise FormatError(f"{name}: a broken PNG: the checksum of its block {block} is wrong")
        position, has_end = chunk_end, chunk_type == b"IEND"
    if not has_end:
        raise FormatError(f"{name}: a truncated PNG: its end is missing")


def _has_16_bits(image_file: Any, data: bytes) -> bool:
    """Return True for a file of 16 bits per channel, which Pillow keeps for greyscale only."""
    if image_file.format == "PNG":
        return data[24] == 16  # bit depth in the header block
    if image_file.format == "PPM":
        return _pnm_maximum(data) > 255
    return image_file.format == "TIFF" and bool(image_file.tag_v2.get(_BITS_PER_SAMPLE, (8,))[0] == 16)


def _has_planes(image_file: Any) -> bool:
    """Return True for a TIFF that stores each channel by itself."""
    return image_file.format == "TIFF" and bool(image_file.tag_v2.get(_PLANAR, 1) == 2)


def _pnm_maximum(data: bytes) -> int:
    """Return the value of white in a PNM file; 1 for bitmaps, which state none."""
    header = re.match(rb"P[2356](?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+\d+(?:\s+|#[^\n]*\n)+(\d+)\s", data[:4096])
    return int(header[1]) if header else 1


def _decode_16_bits(data: bytes, name: str, file_format: str) -> npt.NDArray[np.uint16]:
    """Return uint16 [H, W] or [H, W, C], RGB or RGBA."""
    log_level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it reports broken files on standard error
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(log_level)
    if pixels is None or pixels.dtype != np.uint16 or (pixels.ndim == 3 and pixels.shape[2] not in (1, 3, 4)):
        raise FormatError(f"{name}: 16 bits a channel in a layout that is not supported; save it as PNG")
    if file_format == "PPM":
        maximum = _pnm_maximum(data)
        pixels = np.round(pixels * (65535 / maximum)).clip(0, 65535).astype(np.uint16)
    if pixels.ndim == 3 and pixels.shape[2] > 1:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]  # OpenCV returns BGR or BGRA
    return np.ascontiguousarray(pixels)


def _plain_mode(image: Image.Image, name: str) -> Image.Image:
    """Convert an image to mode L, LA, RGB or RGBA."""
    mode, has_transparency = image.mode, "transparency" in image.info
    if mode in ("P", "PA"):
        return image.convert("RGBA" if has_transparency or mode == "PA" else "RGB")
    if mode in ("L", "RGB") and has_transparency:
        return image.convert(f"{mode}A")
    target_mode = {"1": "L", "La": "LA", "RGBa": "RGBA"}.get(mode)
    if mode in ("CMYK", "YCbCr", "LAB", "HSV", "RGBX"):
        target_mode = "RGB"
    if target_mode is not None:
        return image.convert(target_mode)
    if mode not in ("L", "LA", "RGB", "RGBA"):
        raise FormatError(f"{name}: pixels of mode {mode}; images have 8 or 16 bits a channel")
    return image


def to_8_bits(pixels: npt.NDArray[Any]) -> U8:
    """Round uint16 to uint8; uint8 is returned unchanged."""
    return pixels if pixels.dtype == np.uint8 else ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)


def turn_upright(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Return stored pixels [H, W, ...] as a viewer shows them.

    Args:
        pixels: The pixels in the order of the file.
        orientation: EXIF orientation, 1 to 8.

    Source: CIPA DC-008 (Exif 2.32), tag 274.
    """
    if orientation in (2, 3):
        pixels = pixels[:, ::-1]
    if orientation in (3, 4):
        pixels = pixels[::-1]
    if orientation in (5, 6, 7, 8):
        pixels = pixels.swapaxes(0, 1)
    if orientation in (6, 7):
        pixels = pixels[:, ::-1]
    if orientation in (7, 8):
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)


def turn_back(pixels: npt.NDArray[Any], orientation: int) -> npt.NDArray[Any]:
    """Return upright pixels in the order of a file of this orientation: the inverse of `turn_upright`."""
    return turn_upright(pixels, {6: 8, 8: 6}.get(orientation, orientation))


# ---------------------------------------------------------------- writing


def encode_jpeg(image: U8, quality: int = 95, subsampling: str = "420") -> bytes:
    """Return a JPEG of uint8 [H, W, 3] RGB; subsampling 420 as in the originals, 444 keeps colour noise."""
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality, "RGB", subsampling, fastdct=False))


def encode_png(image: npt.NDArray[Any], *, compression: int | None = None) -> bytes:
    """Return a PNG of [H, W, C], 8 or 16 bits; C is 1 (grey), 3 (RGB) or 4 (RGBA)."""
    parameters = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    return bytes(cv2.imencode(".png", _to_bgr(image), parameters)[1].tobytes())


def _to_bgr(image: npt.NDArray[Any]) -> npt.NDArray[Any]:
    return np.ascontiguousarray(image[..., [2, 1, 0, 3][: image.shape[2]]] if image.shape[2] > 2 else image)


def check_writable(original: ImageFile) -> None:
    """Raise FormatError, with the reason, for a file that `encode_like` cannot write anew without a loss."""
    if original.frames > 1:
        raise FormatError(f"{original.name}: it has {original.frames} frames or pages; save each as a file of its own")
    if original.has_16_bits:
        maximum = int(original.pixels.max())
        if maximum < 4096:
            raise FormatError(
                f"{original.name}: 16 bits a channel, but no value above {maximum}: fewer bits than the file says, or "
                "no photograph; scale it to the full range"
            )
        if original.alpha is not None and original.model == "grey":
            raise FormatError(f"{original.name}: grey with alpha and 16 bits cannot be written; leave out its alpha")


def encode_like(
    original: ImageFile,
    image: U8,
    *,
    quality: int = 95,
    subsampling: str = "420",
    compression: int | None = None,
) -> bytes:
    """Return a file like another, with other colours.

    Format, channels, bits, order of the pixels and EXIF orientation are those of the original, so annotations that
    fit the original fit the result. Alpha is copied. With 16 bits, the upper eight carry the image. Other metadata,
    such as places, colour profiles and the small preview of a camera, are left out.

    Args:
        original: File whose properties are kept; `check_writable` says whether they can be.
        image: Upright uint8 [H, W, 3], RGB.
        quality: Quality of JPEG and lossy WebP.
        subsampling: Of the colours of a JPEG: 444, 422 or 420.
        compression: Of a PNG, 0 to 9; None: OpenCV's default.

    Raises:
        FormatError: See `check_writable`.
    """
    from PIL import Image

    check_writable(original)
    grey = original.model == "grey"
    pixels = np.asarray(Image.fromarray(image).convert("L"))[..., None] if grey else image
    if original.has_16_bits:
        pixels = pixels.astype(np.uint16) * 257
    if original.alpha is not None:
        pixels = np.concatenate([pixels, original.alpha[..., None]], axis=2)
    # A reader of TIFF turns the pixels itself, so they are written upright.
    orientation = 1 if original.format == "TIFF" else original.orientation
    pixels = np.ascontiguousarray(turn_back(pixels, orientation))
    if original.format == "JPEG" and original.model == "RGB":
        return _add_orientation(encode_jpeg(pixels, quality, subsampling), orientation)
    if original.format == "JPEG" and grey:
        encoded = simplejpeg.encode_jpeg(pixels, quality, "GRAY", "Gray", fastdct=False)
        return _add_orientation(bytes(encoded), orientation)
    if original.format == "PNG" and pixels.shape[2] != 2:
        return _add_orientation(encode_png(pixels, compression=compression), orientation)
    if original.has_16_bits:
        suffix = ".tiff" if original.format == "TIFF" else ".pgm" if grey else ".ppm"
        return bytes(cv2.imencode(suffix, _to_bgr(pixels))[1].tobytes())
    picture = Image.fromarray(pixels[..., 0] if pixels.shape[2] == 1 else pixels)
    if original.model == "CMYK":
        picture = picture.convert("CMYK")
    options: dict[str, Any] = {}
    if original.format == "JPEG":
        options = {"quality": quality, "subsampling": {"444": 0, "422": 1, "420": 2}[subsampling]}
    elif original.format == "WEBP":
        options = {"quality": quality, "lossless": original.lossless, "exact": True}
    elif original.format == "TIFF":
        options = {"compression": "tiff_adobe_deflate"}
    if orientation != 1:
        exif = Image.Exif()
        exif[_ORIENTATION] = orientation
        options["exif"] = exif
    stream = io.BytesIO()
    picture.save(stream, original.format, **options)
    return stream.getvalue()


def _add_orientation(data: bytes, orientation: int) -> bytes:
    """Add an EXIF block with an orientation to a JPEG or PNG; upright files stay as they are."""
    if orientation == 1:
        return data
    tiff = struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, _ORIENTATION, 3, 1, orientation, 0, 0)
    if data.startswith(_PNG):
        block = b"eXIf" + tiff
        chunk = struct.pack(">I", len(tiff)) + block + struct.pack(">I", zlib.crc32(block))
        return data[:_PNG_BLOCKS] + chunk + data[_PNG_BLOCKS:]
    segment = b"Exif\0\0" + tiff
    # JFIF asks for its own segment to be the first.
    start = 2 + (2 + int.from_bytes(data[4:6], "big") if data[2:4] == b"\xff\xe0" else 0)
    return data[:start] + struct.pack(">HH", 0xFFE1, len(segment) + 2) + segment + data[start:]


# ---------------------------------------------------------------- recognition


def is_image(path: Path) -> bool:
    """Return whether a file is an image or a video by its name or its first bytes, in any format.

    Raises:
        FormatError: The file cannot be opened.
    """
    if path.suffix.lower() in (*SUFFIXES, *_OTHER_SUFFIXES):
        return True
    try:
        with open(path, "rb") as file:
            beginning = file.read(64)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror or error}") from None
    return any(signature.match(beginning) for signature in _SIGNATURES)
