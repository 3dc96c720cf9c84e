"""Stop lamps and indicators of vehicles, from their motion."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from ssad.core.types import TurnSignal
from ssad.rendering.camera.scene import LampSignal
from ssad.rendering.vehicle_signals import FLASH_RATE, flashing, trace_signals, vehicle_signals


def test_stop_lamps_shine_while_slowing_down_and_standing() -> None:
    """Above 0.7 m/s^2, in reverse too; a vehicle that never moved is parked."""
    before = np.array([10.0, 10.0, 10.0, -3.0, 0.05, 0.0, 10.0], np.float32)
    now = np.array([9.9, 9.95, 10.2, -2.8, 0.05, 0.0, 9.0], np.float32)
    walked = np.array([5.0, 5.0, 5.0, 5.0, 5.0, 0.0, 5.0])
    has_lamps = np.array([True] * 6 + [False])
    turn = np.zeros(7, np.int8)
    signals = vehicle_signals(before, now, walked, turn, 0.1, has_lamps)
    assert signals.tolist() == [LampSignal.BRAKE, 0, 0, LampSignal.BRAKE, LampSignal.BRAKE, 0, 0]


def test_indicators_flash() -> None:
    """On the side of the turn, half of the time; the stop lamp does not flash."""
    speed, walked = np.full(2, 5.0, np.float32), np.ones(2)
    turn = np.array([TurnSignal.LEFT, TurnSignal.RIGHT], np.int8)
    signals = vehicle_signals(speed, speed - 1, walked, turn, 0.1, np.ones(2, bool))
    assert signals.tolist() == [LampSignal.BRAKE | LampSignal.LEFT, LampSignal.BRAKE | LampSignal.RIGHT]
    times = (np.arange(40) + 0.5) / 40 * 2 / FLASH_RATE
    shown = np.array([flashing(signals, float(time), [0, 1]) for time in times])
    assert (shown & LampSignal.BRAKE > 0).all()
    for agent, side in enumerate((LampSignal.LEFT, LampSignal.RIGHT)):
        lit = shown[:, agent] & side > 0
        assert lit.mean() == 0.5
        assert np.abs(np.diff(lit.astype(int))).sum() in {3, 4}, "two flashes in two periods"
    assert (shown[:, 0] & LampSignal.LEFT > 0).tolist() != (shown[:, 1] & LampSignal.RIGHT > 0).tolist()


def test_a_trace_says_who_brakes_and_turns() -> None:
    speed = np.array([[5.0, 0.0, 3.0], [5.0, 0.0, 2.0], [4.0, 0.0, 2.0]], np.float32)
    x = np.cumsum(speed * 0.1, axis=0)
    turn = np.array([[0, 0, 0], [1, 0, 0], [1, 0, -1]], np.int8)
    trace = SimpleNamespace(models=("car", "car", "walker"), x=x, y=0 * x, speed=speed, turn_signal=turn, dt=0.1)
    brake, left = int(LampSignal.BRAKE), int(LampSignal.LEFT)
    assert trace_signals(trace).tolist() == [[0, 0, 0], [left, 0, 0], [left | brake, 0, 0]]  # type: ignore[arg-type]
    trace.turn_signal = np.zeros((0, 0), np.int8)
    assert trace_signals(trace).tolist() == [[0, 0, 0], [0, 0, 0], [brake, 0, 0]]  # type: ignore[arg-type]
