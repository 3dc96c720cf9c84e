"""Six-camera samples a minute of `ssad record`: python benchmarks/record_speed.py [--device cpu|cuda] [--workers N]
[--samples N] [--width W] [--out FILE]

Records at least N samples of four towns (scenes of 10 s) into a temporary folder, twice; the faster run counts, since
the first one also compiles kernels. The time is of the whole recording, tables and files included.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import tempfile
import time
from pathlib import Path

from ssad.recorders.nuscenes import TOWNS, Recording, record_nuscenes


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--samples", type=int, default=84)
    parser.add_argument("--width", type=int, default=1600)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    seconds = 10.0
    each = int(seconds / 0.5) + 1
    scenes = math.ceil(options.samples / each / len(TOWNS))
    times = []
    for run in range(options.runs):
        with tempfile.TemporaryDirectory() as folder:
            todo = Recording(
                Path(folder) / "set",
                scenes=scenes,
                seconds=seconds,
                width=options.width,
                seed=run,
                device=options.device,
            )
            start = time.perf_counter()
            record_nuscenes(todo, workers=options.workers)
            times.append(time.perf_counter() - start)
            print(f"{times[-1]:.1f} s", flush=True)
    samples = scenes * each * len(TOWNS)
    found = {
        "device": options.device,
        "machine": platform.machine(),
        "workers": options.workers,
        "width": options.width,
        "samples": samples,
        "seconds": [round(t, 1) for t in times],
        "s_per_1000": round(1000 * min(times) / samples, 1),
    }
    print(json.dumps(found))
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
