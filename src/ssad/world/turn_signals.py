"""Turn signals of the agents that the world drives: of lane changes, and of turns at junctions."""

from __future__ import annotations

import numpy as np

from ssad.core.types import F32, I8, Bool, TurnSignal
from ssad.world.kernels.data import TurnRank

BEFORE_TURN = 30.5  # m before a turn from which drivers indicate: 100 feet (California Vehicle Code, section 22108)
TIME_BEFORE_TURN = 3.0  # s before it, where they are faster


def turn_sides(turn_rank: F32, *, left_hand: bool) -> I8:
    """Return the `TurnSignal` [N] of the turns at the junctions of route points.

    Args:
        turn_rank: [N] `TurnRank` of each turn; RIGHT is to the near side.
        left_hand: Whether traffic keeps to the left.
    """
    near, far = (TurnSignal.LEFT, TurnSignal.RIGHT) if left_hand else (TurnSignal.RIGHT, TurnSignal.LEFT)
    turn = turn_rank.astype(np.int32) % int(TurnRank.YIELD)
    sides: I8 = np.select([turn == TurnRank.RIGHT, turn == TurnRank.LEFT], [int(near), int(far)], 0).astype(np.int8)
    return sides


def turn_signals(
    *, shift: F32, along: F32, speed: F32, junction_distance: F32, turn: I8, half_length: F32, indicates: Bool
) -> I8:
    """Return the `TurnSignal` of agents. All arrays are [B, A], `shift` [B, A, 4].

    A lane change is indicated from the decision to its end, and goes before a turn. A turn is indicated from
    `BEFORE_TURN` m or `TIME_BEFORE_TURN` s before the junction, whichever is earlier, to the end of the junction.

    Args:
        shift: Lane changes as in `State.shift`.
        along: Place on the route, m.
        speed: m/s.
        junction_distance: From the centre to the next junction, m; 0 inside.
        turn: `TurnSignal` of the turn there.
        half_length: Half length of the body, m.
        indicates: Whether the agent shows turn signals at all.
    """
    change = np.where(along < shift[..., 1], np.sign(shift[..., 3] - shift[..., 2]), 0.0)
    lead = np.maximum(BEFORE_TURN, TIME_BEFORE_TURN * speed)
    turning = np.where(junction_distance - half_length < lead, turn, 0)
    signals: I8 = np.where(indicates, np.where(change != 0.0, change, turning), 0).astype(np.int8)
    return signals
