"""Embedded world: batched, headless and deterministic, with one source for CPU and CUDA."""
