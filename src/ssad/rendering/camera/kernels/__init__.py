"""Warp kernels of the camera: one source for CPU and CUDA.

No `from __future__ import annotations` here: Warp reads the annotations as types.
"""
