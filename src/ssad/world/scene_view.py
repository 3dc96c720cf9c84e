"""Top views of a world's scenes, and a window that shows them."""

from __future__ import annotations

from typing import Any

import numpy as np

from ssad.core.errors import ConfigError, install_extra
from ssad.core.top_view import TopView, TopViewScene, lit_turn_signals
from ssad.core.types import U8
from ssad.world.world import World

NEAR = 80.0  # m around the ego in which traffic lights are drawn


class SceneViews:
    """Renderer of a world's current scenes; a town's roads are prepared when it is first drawn."""

    def __init__(self, world: World) -> None:
        self.world = world
        self._towns: dict[str, TopView] = {}

    def draw(self, scene: int) -> U8:
        """Render a scene from above, RGB [540, 960, 3]."""
        state = self.world.state()
        episode = self.world.episodes[int(self.world.assigned[scene])]
        graph = self.world.graphs[episode.town]
        if episode.town not in self._towns:
            self._towns[episode.town] = TopView(graph)
        pose = np.asarray(state.pose[scene], np.float64)
        first, count = (int(value) for value in state.route[scene, 0])
        signal_states = state.signal[scene]
        near_signals = np.flatnonzero(np.linalg.norm(graph.signal_xy.reshape(-1, 2) - pose[0, :2], axis=1) < NEAR)
        signals = [(*map(float, graph.signal_xy[signal]), int(signal_states[signal])) for signal in near_signals]
        time, completion = float(state.time[scene]), float(state.route_complete[scene])
        has_drivers = any(agent.driver is not None for agent in episode.agents)
        return self._towns[episode.town].draw(
            TopViewScene(
                pose,
                state.size[scene],
                state.kind[scene],
                state.active[scene],
                state.roads.path[first : first + count, :2],
                np.zeros((0, 2)),
                signals,  # type: ignore[arg-type]
                hit=6 if state.contact[scene] else None,
                turn_signal=lit_turn_signals(state.turn_signal[scene], time) if has_drivers else None,
                words=[f"{time:5.1f} s   {float(state.speed[scene, 0]):5.1f} m/s   route {completion:3.0f} %"],
            )
        )


class Window:
    """A pygame window (the extra `window`), opened with the first image."""

    def __init__(self, rate: float) -> None:
        try:
            import pygame
        except ImportError:
            raise ConfigError(f'render_mode="human" needs pygame; {install_extra("window")}') from None
        self._pygame: Any = pygame
        self._surface: Any = None
        self._rate = rate

    def __reduce__(self) -> tuple[type[Window], tuple[float]]:
        """Copies of an environment share no window: each opens its own with its first image."""
        return Window, (self._rate,)

    def show(self, image: U8) -> None:
        """Show a picture, RGB [H, W, 3], no sooner than the rate allows."""
        if self._surface is None:
            self._pygame.init()
            self._surface = self._pygame.display.set_mode(image.shape[1::-1])
            self._pygame.display.set_caption("SSAD")
            self._clock = self._pygame.time.Clock()
        self._pygame.event.pump()
        self._surface.blit(self._pygame.surfarray.make_surface(image.swapaxes(0, 1)), (0, 0))
        self._pygame.display.flip()
        self._clock.tick(self._rate)

    def close(self) -> None:
        """Close the window."""
        if self._surface is not None:
            self._pygame.display.quit()
            self._surface = None
