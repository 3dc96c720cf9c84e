"""Properties of this machine (devices, cores, versions), and a quiet start of Warp."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ssad.core.errors import ConfigError
from ssad.core.version import __version__


def cuda_driver() -> bool:
    """Return whether NVIDIA's driver is installed; checked before Warp is loaded, which warns if it is missing."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


@cache
def start_warp_quietly() -> None:
    """Start Warp, once per process, without its banner and its notes about the kernel cache."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    if cuda_driver():
        warp.init()
        return
    saved_stderr, null_device = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:  # Warp's native code writes its warning to the descriptor, past sys.stderr
        os.dup2(null_device, 2)
        warp.init()
    finally:
        os.dup2(saved_stderr, 2)
        os.close(saved_stderr)
        os.close(null_device)


def retain_freed_memory(size: int = 1 << 30) -> None:
    """Let this process keep the memory of freed CPU tensors for reuse; takes effect only with glibc.

    By default, glibc returns large blocks to the system and requests them again, page by page, in each pass of a
    network.

    Args:
        size: Largest block, and most free memory at the end of the heap, that the process keeps, bytes.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(-3, size)  # M_MMAP_THRESHOLD
        library.mallopt(-1, size)  # M_TRIM_THRESHOLD


def pick_device(requested: str) -> str:
    """auto, cpu or cuda as a device of the world. ConfigError when it is not there."""
    if requested == "cpu":
        return "cpu"
    if requested not in ("auto", "cuda"):
        raise ConfigError(f"--device {requested}: expected auto, cpu or cuda")
    if cuda_driver():
        import warp

        start_warp_quietly()
        if warp.is_cuda_available():
            return "cuda"
    if requested == "cuda":
        raise ConfigError("--device cuda: no CUDA device is usable here (see: ssad doctor); use --device cpu")
    return "cpu"


def default_workers() -> int:
    """Return the number of workers: one for each core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(device: str) -> dict[str, str]:
    """Return the versions that a record carries."""
    result = {"ssad": __version__, "python": platform.python_version(), "device": device}
    for name in ("numpy", "warp-lang", "torch"):
        try:
            result[name] = version(name)
        except PackageNotFoundError:
            continue
    return result


def machine_properties() -> dict[str, str]:
    """Return the operating system, processor and core count of this machine; neither its name nor its user."""
    name = platform.processor()
    with contextlib.suppress(OSError):  # Linux names the processor here
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    properties = {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": name,
        "cores": str(default_workers()),
    }
    return {key: value for key, value in properties.items() if value}


def visible_gpus() -> list[str]:
    """Return the CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    selection = os.environ.get("CUDA_VISIBLE_DEVICES")
    if selection is not None:
        return [name.strip() for name in selection.split(",") if name.strip()]
    import warp

    start_warp_quietly()
    return [str(index) for index in range(warp.get_cuda_device_count())]


# processes that share a GPU: planning a shift and reading pictures is work for the host; and memory of each, bytes
GPU_WORKERS, GPU_SHARE = 14, 4 << 30


def gpu_workers(gpus: int) -> int:
    """Return the number of processes that share the first `gpus` visible GPUs."""
    if not gpus:
        return 0
    import warp

    start_warp_quietly()
    memory = [device.total_memory for device in warp.get_cuda_devices()[:gpus]]
    return sum(max(1, min(GPU_WORKERS, size // GPU_SHARE)) for size in memory)
