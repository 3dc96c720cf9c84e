"""Darknet `.weights` files: a header of three or four numbers, then the layers' float32 values without names.

Header: int32 major, minor, revision, then the number of images seen, 8 bytes from version 0.2 on, else 4. For each
convolution in the order of the layer table: with batch norm its bias, weight, mean and variance, else the bias of the
convolution; then its kernel [outputs, inputs, rows, columns]. All little-endian.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from ssad.core.errors import ConfigError, FormatError
from ssad.core.safeio import MIB, read_bytes
from ssad.detectors.yolo.detector import Yolo
from ssad.detectors.yolo.layers import ConvUnit
from ssad.detectors.yolo.models import CSPNetwork

MAX_BYTES = 1024 * MIB


def convolutions(detector: Yolo) -> list[list[Tensor]]:
    """The values of each convolution in the file's order.

    Raises:
        ConfigError: The network is not one of darknet's.
    """
    if isinstance(detector.network, CSPNetwork):
        raise ConfigError(f"{detector.name} is no darknet network; .weights files are for YOLOv3 and YOLOv3-tiny")
    layers: list[list[Tensor]] = []
    inside = {id(part.conv) for part in detector.network.modules() if isinstance(part, ConvUnit)}
    for part in detector.network.modules():
        if isinstance(part, ConvUnit):
            mean, variance = part.norm.running_mean, part.norm.running_var
            assert mean is not None
            assert variance is not None
            layers.append([part.norm.bias, part.norm.weight, mean, variance, part.conv.weight])
        elif isinstance(part, nn.Conv2d) and id(part) not in inside:
            assert part.bias is not None
            layers.append([part.bias, part.weight])
    return layers


def read_darknet(detector: Yolo, path: str | Path, *, layers: int | None = None) -> int:
    """Fill the detector with a file's weights.

    Args:
        detector: The detector; it stays unchanged on an error.
        path: The file.
        layers: Only the first so many convolutions, for trunk files such as darknet53.conv.74 (52); the rest stays as
            it is.

    Returns:
        Number of images that the weights have seen.

    Raises:
        FormatError: The file is missing, truncated, of another network, or holds values that cannot be weights.
    """
    wanted = convolutions(detector)
    if layers is not None and not 0 < layers <= len(wanted):
        raise ConfigError(f"{detector.name} has {len(wanted)} convolutions; layers={layers} is not among them")
    tensors = [tensor for layer in wanted[:layers] for tensor in layer]
    data = read_bytes(path, limit=MAX_BYTES)
    if len(data) < 20:
        raise FormatError(f"{path}: not a darknet weights file: {len(data)} bytes")
    major, minor, _ = struct.unpack_from("<3i", data)
    if not (0 <= major < 1000 and 0 <= minor < 1000):
        raise FormatError(f"{path}: not a darknet weights file: version {major}.{minor}")
    long = major * 10 + minor >= 2
    (seen,) = struct.unpack_from("<q" if long else "<i", data, 12)
    header = 20 if long else 16
    count = sum(tensor.numel() for tensor in tensors)
    if len(data) != header + 4 * count:
        raise FormatError(
            f"{path}: {len(data)} bytes, but {detector.name} with {len(detector.classes)} classes takes "
            f"{header + 4 * count}: the file is cut short or of another network"
        )
    values = np.frombuffer(data, "<f4", offset=header)
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: holds NaN or infinite weights")
    parts, start = [], 0
    for tensor in tensors:
        parts.append(torch.from_numpy(values[start : start + tensor.numel()].copy()).view(tensor.shape))
        start += tensor.numel()
    variances = {id(layer[3]) for layer in wanted if len(layer) == 5}
    for tensor, part in zip(tensors, parts, strict=True):
        if id(tensor) in variances and bool((part < 0).any()):
            raise FormatError(f"{path}: holds a negative variance: the file is of another network")
    with torch.no_grad():
        for tensor, part in zip(tensors, parts, strict=True):
            tensor.copy_(part)
    return int(seen)
