"""Five encounters from above, as docs/reference/scenarios.md shows them: python -m benchmarks.class_views

One scenario of each class is driven by the blind follower up to the collision, and by the Autopilot, which avoids it,
up to where both are nearest to each other.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from ssad.core.machine import start_warp_quietly
from ssad.core.types import AgentKind
from ssad.drivers import make_system
from ssad.experiments.adversarial.collision_view import draw_collision
from ssad.training.driver import draw_episodes, find_scenarios
from ssad.world.rollout import rollout
from ssad.world.world import World

OUT = Path(__file__).resolve().parents[1] / "docs" / "images" / "encounters.png"
VIEWS = {
    "cut-in": "LaneChanging",
    "left turn": "UnprotectedLeftTurn",
    "right turn": "RightTurn",
    "opposite vehicle": "VehiclePassing",
    "crossing": "CrossingNegotiation",
}
SIZE = 420  # pixels


def main() -> None:
    """Drive, draw and write."""
    start_warp_quietly()
    figure, axes = plt.subplots(2, len(VIEWS), figsize=(12.5, 5.4), layout="constrained")
    for column, (name, kind) in enumerate(VIEWS.items()):
        scenarios, graphs = find_scenarios([f"{kind}/00"])
        episodes = draw_episodes(scenarios, graphs, draws=1, seed=0)
        (graph,) = graphs.values()
        for row, system in enumerate(("blind", "autopilot")):
            (trace,) = rollout(World(episodes, graphs), make_system(system))
            span = np.hypot(np.ptp(trace.x, axis=0), np.ptp(trace.y, axis=0))
            others = [int(k) for k in np.flatnonzero((trace.kind != AgentKind.PROP) & (span > 1.0)) if k]
            gap = np.hypot(*(part[:, others] - part[:, :1] for part in (trace.x, trace.y))).min(1)
            last = None if trace.contact.any() else int(gap.argmin())
            picture = draw_collision(trace, graph, others, size=SIZE, last_step=last)
            axis = axes[row, column]
            axis.imshow(picture)
            axis.set_axis_off()
            axis.set_title(f"{name}, {system}: {trace.end}", fontsize=9)
    figure.savefig(OUT, dpi=100, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    main()
