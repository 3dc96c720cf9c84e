"""Warp kernels of the shifts: one source for CPU and CUDA.

No `from __future__ import annotations` in this package: Warp reads the annotations as types. Images are flat bytes,
RGB interleaved, image b from b * stride; grids are [B, h, w] at a quarter of the resolution.
"""
