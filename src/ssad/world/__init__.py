"""The embedded world: batched, headless, deterministic, one source for CPU and CUDA."""
