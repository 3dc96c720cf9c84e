"""Stop lamps and indicators of vehicles, from their motion and their turn signals in a trace."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from ssad.core.types import F32, F64, I8, U8, AgentKind, Bool, EpisodeTrace, TurnSignal
from ssad.rendering.camera.scene import LampSignal
from ssad.world.models import MODELS

WITH_LAMPS: Final = (AgentKind.CAR, AgentKind.TRUCK, AgentKind.BUS, AgentKind.MOTORCYCLE)
STOP_DECELERATION: Final = 0.7  # m/s^2 above which stop lamps may shine (UN Regulation No. 13-H, 5.2.22)
STANDSTILL: Final = 0.1  # m/s below which the foot is on the brake
FLASH_RATE: Final = 1.5  # Hz, of indicators (UN Regulation No. 6: 60 to 120 a minute)
PHASE: Final = 0.382  # period's share between two agents, so that indicators do not flash in step


def vehicle_signals(  # noqa: PLR0917
    previous_speed: F32, speed: F32, walked: F64, turn: I8, dt: float, has_lamps: Bool
) -> U8:
    """Return the `LampSignal` bits of agents; indicators are set throughout, see `flashing`.

    Stop lamps shine while an agent slows down, and while it stands after it has moved. All arrays have one shape.

    Args:
        previous_speed: Speed a step before, m/s.
        speed: Speed now.
        walked: Distance covered since the start, m.
        turn: `TurnSignal`.
        dt: Time of a step, s.
        has_lamps: Whether the agent has such lamps.
    """
    is_slowing = np.abs(previous_speed) - np.abs(speed) > STOP_DECELERATION * dt
    is_standing = (np.abs(speed) < STANDSTILL) & (walked > 0.0)
    bits = np.where(is_slowing | is_standing, int(LampSignal.BRAKE), 0)
    bits |= np.where(turn == TurnSignal.LEFT, int(LampSignal.LEFT), 0)
    bits |= np.where(turn == TurnSignal.RIGHT, int(LampSignal.RIGHT), 0)
    signals: U8 = np.where(has_lamps, bits, 0).astype(np.uint8)
    return signals


def with_lamps(models: Sequence[str]) -> Bool:
    """Return whether agents of models have head lamps, stop lamps and indicators [A]."""
    return np.array([MODELS[model].kind in WITH_LAMPS for model in models], bool)


def trace_signals(trace: EpisodeTrace) -> U8:
    """Return the `LampSignal` bits [T, A] of the agents of a trace, see `vehicle_signals`."""
    steps = np.hypot(np.diff(trace.x, axis=0, prepend=trace.x[:1]), np.diff(trace.y, axis=0, prepend=trace.y[:1]))
    turn = trace.turn_signal if trace.turn_signal.size else np.zeros(trace.speed.shape, np.int8)
    previous_speed = np.concatenate([trace.speed[:1], trace.speed[:-1]])
    walked = np.cumsum(steps, axis=0, dtype=np.float64)
    has_lamps = np.broadcast_to(with_lamps(trace.models), trace.speed.shape)
    return vehicle_signals(previous_speed, trace.speed, walked, turn, trace.dt, has_lamps)


def flashing(signals: npt.ArrayLike, time: float, agents: npt.ArrayLike) -> npt.NDArray[np.int32]:
    """Return the `LampSignal` bits at a moment: indicators are off during half of each period.

    Args:
        signals: Bits of the agents.
        time: s.
        agents: Numbers of the agents, which decide the phase; of the shape of `signals`.
    """
    is_bright = (time * FLASH_RATE + np.asarray(agents) * PHASE) % 1.0 < 0.5
    visible_bits = np.where(is_bright, ~0, int(LampSignal.BRAKE))
    return np.asarray(np.asarray(signals, np.int32) & visible_bits, np.int32)
