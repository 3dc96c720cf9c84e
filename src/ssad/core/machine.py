"""What this machine has: devices, cores, versions; and how Warp is started quietly."""

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
    """Whether this machine has NVIDIA's driver; asked before Warp is loaded, which warns when there is none."""
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    return True


@cache
def quiet_warp() -> None:
    """Start Warp, once a process, and keep its banner and its notes about the kernel cache off the terminal."""
    import warp

    warp.config.log_level = warp.LOG_ERROR
    if cuda_driver():
        warp.init()
        return
    kept, null = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:  # its native part warns of the missing driver on the descriptor itself
        os.dup2(null, 2)
        warp.init()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(null)


def keep_memory(size: int = 1 << 30) -> None:
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


def pick_device(wanted: str) -> str:
    """auto, cpu or cuda as a device of the world. ConfigError when it is not there."""
    if wanted == "cpu":
        return "cpu"
    if wanted not in ("auto", "cuda"):
        raise ConfigError(f"--device {wanted}: expected auto, cpu or cuda")
    if cuda_driver():
        import warp

        quiet_warp()
        if warp.is_cuda_available():
            return "cuda"
    if wanted == "cuda":
        raise ConfigError("--device cuda: no CUDA device is usable here (see: ssad doctor); use --device cpu")
    return "cpu"


def default_workers() -> int:
    """One worker a core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def versions(device: str) -> dict[str, str]:
    """Versions that a record carries."""
    found = {"ssad": __version__, "python": platform.python_version(), "device": device}
    for name in ("numpy", "warp-lang", "torch"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def machine() -> dict[str, str]:
    """What a run was made on: operating system, processor, cores. No name of it or of its user."""
    name = platform.processor()
    with contextlib.suppress(OSError):  # Linux says more here
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        name = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), name)
    found = {"system": f"{platform.system()} {platform.machine()}", "processor": name, "cores": str(default_workers())}
    return {key: value for key, value in found.items() if value}


def visible_gpus() -> list[str]:
    """The CUDA devices that this process may use, as CUDA_VISIBLE_DEVICES names them."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is not None:
        return [name.strip() for name in given.split(",") if name.strip()]
    import warp

    quiet_warp()
    return [str(k) for k in range(warp.get_cuda_device_count())]


# processes that share a GPU: planning a shift and reading pictures is work for the host; and memory of each, bytes
GPU_WORKERS, GPU_SHARE = 14, 4 << 30


def gpu_workers(gpus: int) -> int:
    """How many processes share so many GPUs (the first ones that are visible)."""
    if not gpus:
        return 0
    import warp

    quiet_warp()
    memory = [device.total_memory for device in warp.get_cuda_devices()[:gpus]]
    return sum(max(1, min(GPU_WORKERS, size // GPU_SHARE)) for size in memory)
