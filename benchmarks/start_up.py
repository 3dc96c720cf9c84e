"""How long a user waits for nothing: `import ssad`, `ssad --help`, and asking a town for lanes.

    uv run python benchmarks/start_up.py

Medians over repeats, each of the first two as a whole process.
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np

from ssad.world.roads import LaneQuery, load_town, town_names
from ssad.world.roads.query import DRIVABLE


def median(work: Callable[[], object], repeats: int = 7) -> float:
    """Median seconds of `work`."""
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return statistics.median(times)


def process(*arguments: str) -> Callable[[], object]:
    """A call that runs Python with these arguments to its end."""
    return lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True)


def main() -> None:
    """Print the figures."""
    idle = median(process("-c", "pass"))
    print(f"python alone   {idle:.3f} s")
    print(f"import ssad    {median(process('-c', 'import ssad')):.3f} s")
    print(f"ssad --help    {median(process('-m', 'ssad', '--help')):.3f} s")
    for name in town_names():
        graph = load_town(name)
        query = LaneQuery(graph)
        low, high = graph.xy.min(axis=0), graph.xy.max(axis=0)
        points = np.random.default_rng(0).uniform(low, high, (100_000, 2)).astype(np.float32)
        build = median(lambda g=graph: LaneQuery(g).grid(DRIVABLE))
        ask = median(lambda q=query, p=points: q.nearest(p))
        print(f"{name:<14} lane query {1e3 * build:.1f} ms, 100,000 points {1e3 * ask:.0f} ms")


if __name__ == "__main__":
    main()
