"""Warp kernels of the camera: one source for CPU and CUDA.

Modules with kernels must not import annotations from `__future__`, because Warp reads annotations as types.
"""
