"""Encounters that careful drivers judge: one other road user in the frame of the driver's path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, Bool


@dataclass(frozen=True)
class Encounter:
    """Others as seen from drivers that keep their paths; all arrays have one shape, or shapes that broadcast to it.

    Along the path is ahead, across it is to the side, whichever side. A lead vehicle, a car that cuts in, a walker who
    crosses and an oncoming car are the same thing here: they differ in `lead`, `lateral` and `approach`.

    Attributes:
        speed: Of the driver along its path, m/s.
        accel: Of the driver, m/s^2.
        gap: From the driver's front to the near end of the other along the path, m; negative beside and behind it.
        lead: Speed of the other along the path, m/s; negative: it comes towards the driver.
        lateral: Across the path between the two bodies, m; 0 or less: the other is in the way.
        approach: Speed at which `lateral` falls, m/s; negative: the other moves away.
        through: How far the other must move across the path until it has left it on the far side, m; infinite for who
            stays on it.
        length: Of both bodies along the path, m: the driver is past once `gap` is below -`length`.
        moved: How far the other has moved across towards the path since it began to, m.
    """

    speed: F64
    accel: F64
    gap: F64
    lead: F64
    lateral: F64
    approach: F64
    through: F64
    length: F64
    moved: F64

    def closing(self) -> F64:
        """Return the speed at which the gap falls, m/s."""
        return self.speed - self.lead

    def time_to_reach(self) -> F64:
        """Return the TTC along the path, s: 0 for a closed gap, infinite for one that does not fall."""
        closing = self.closing()
        # np.where evaluates both branches: the divisor must not be 0.
        divisor = np.where(closing > 0.0, closing, 1.0)
        return np.where(closing > 0.0, np.maximum(self.gap, 0.0) / divisor, np.where(self.gap <= 0.0, 0.0, np.inf))

    def time_to_pass(self) -> F64:
        """Return the time until the driver is past the other, s: the gross longitudinal headway of the FSM."""
        closing = self.closing()
        divisor = np.where(closing > 0.0, closing, 1.0)
        return np.where(closing > 0.0, np.maximum(self.gap + self.length, 0.0) / divisor, np.inf)

    def time_to_enter(self) -> F64:
        """Return the time until the other is in the path, s: 0 if it is, infinite if it does not approach."""
        divisor = np.where(self.approach > 0.0, self.approach, 1.0)
        arrival = np.where(self.approach > 0.0, np.maximum(self.lateral, 0.0) / divisor, np.inf)
        return np.where(self.lateral <= 0.0, 0.0, arrival)

    def time_to_leave(self) -> F64:
        """Return the time until the other has crossed and left the path, s."""
        divisor = np.where(self.approach > 0.0, self.approach, 1.0)
        return np.where(self.approach > 0.0, self.through / divisor, np.inf)

    def ahead(self) -> Bool:
        """Return True where the driver is not yet past the other and gets nearer."""
        return np.asarray((self.gap > -self.length) & (self.closing() > 0.0))
