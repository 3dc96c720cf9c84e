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
    """Return the tensors of each convolution in the order of the file.

    Raises:
        ConfigError: The network is not one of darknet's.
    """
    if isinstance(detector.network, CSPNetwork):
        raise ConfigError(f"{detector.name} is no darknet network; .weights files are for YOLOv3 and YOLOv3-tiny")
    layers: list[list[Tensor]] = []
    unit_convolutions = {id(module.conv) for module in detector.network.modules() if isinstance(module, ConvUnit)}
    for module in detector.network.modules():
        if isinstance(module, ConvUnit):
            mean, variance = module.norm.running_mean, module.norm.running_var
            assert mean is not None
            assert variance is not None
            layers.append([module.norm.bias, module.norm.weight, mean, variance, module.conv.weight])
        elif isinstance(module, nn.Conv2d) and id(module) not in unit_convolutions:
            assert module.bias is not None
            layers.append([module.bias, module.weight])
    return layers


def read_darknet(detector: Yolo, path: str | Path, *, layers: int | None = None) -> int:
    """Load a file's weights into the detector.

    Args:
        detector: The detector; it stays unchanged on an error.
        path: The file.
        layers: Number of convolutions to load from the start, for trunk files such as darknet53.conv.74 (52); the
            others keep their weights. None for all.

    Returns:
        Number of training images that the file records.

    Raises:
        FormatError: The file is missing, truncated, of another network, or holds values that cannot be weights.
    """
    convolution_tensors = convolutions(detector)
    if layers is not None and not 0 < layers <= len(convolution_tensors):
        raise ConfigError(
            f"{detector.name} has {len(convolution_tensors)} convolutions; layers={layers} is not among them"
        )
    tensors = [tensor for layer in convolution_tensors[:layers] for tensor in layer]
    content = read_bytes(path, limit=MAX_BYTES)
    if len(content) < 20:
        raise FormatError(f"{path}: not a darknet weights file: {len(content)} bytes")
    major, minor, _ = struct.unpack_from("<3i", content)
    if not (0 <= major < 1000 and 0 <= minor < 1000):
        raise FormatError(f"{path}: not a darknet weights file: version {major}.{minor}")
    has_long_counter = major * 10 + minor >= 2
    (images_seen,) = struct.unpack_from("<q" if has_long_counter else "<i", content, 12)
    header_size = 20 if has_long_counter else 16
    value_count = sum(tensor.numel() for tensor in tensors)
    if len(content) != header_size + 4 * value_count:
        raise FormatError(
            f"{path}: {len(content)} bytes, but {detector.name} with {len(detector.classes)} classes takes "
            f"{header_size + 4 * value_count}: the file is cut short or of another network"
        )
    values = np.frombuffer(content, "<f4", offset=header_size)
    if not np.isfinite(values).all():
        raise FormatError(f"{path}: holds NaN or infinite weights")
    file_tensors, start = [], 0
    for tensor in tensors:
        file_tensors.append(torch.from_numpy(values[start : start + tensor.numel()].copy()).view(tensor.shape))
        start += tensor.numel()
    # Shifted layers, as of another network of equal size, show as negative variances.
    variances = {id(layer[3]) for layer in convolution_tensors if len(layer) == 5}
    for tensor, file_tensor in zip(tensors, file_tensors, strict=True):
        if id(tensor) in variances and bool((file_tensor < 0).any()):
            raise FormatError(f"{path}: holds a negative variance: the file is of another network")
    with torch.no_grad():
        for tensor, file_tensor in zip(tensors, file_tensors, strict=True):
            tensor.copy_(file_tensor)
    return int(images_seen)
