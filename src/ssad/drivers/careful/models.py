"""The four careful drivers of the regulation literature, as functions of an encounter: when they brake, and how hard.

Source: UN Regulation 157 (2021), Annex 4, Appendix 3 (careful and competent human driver) and paragraph 5.2.5.2;
Shalev-Shwartz et al. 2017 (RSS) with the parameters, and Mattas et al. 2020 and 2022 (Fuzzy Safety Model) with the
formulas, that the Joint Research Centre compares them with. Where these speak of a car that cuts in, SSAD reads: of
anybody who comes into the path (see `Encounter`), and adds one rule: who will have left the path before the driver
reaches it is no danger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.errors import unknown_name
from ssad.core.types import F64, Bool
from ssad.drivers.careful.encounter import Encounter

HARD = 0.774 * 9.81  # m/s^2: what a careful human brakes with in an emergency (about 7.59)
JERK = HARD / 0.6  # m/s^3: it takes 0.6 s to get there (about 12.65)
SPARE = 0.1  # s between the other's leaving the path and the driver's arrival, and the other way round


@dataclass(frozen=True)
class CarefulModel:
    """A model: what it demands, and how it follows its own demand.

    Attributes:
        name: Its short name.
        delay: s from the moment that the danger is perceived to the first braking.
        jerk: m/s^3 by which braking may grow; infinite: at once.
        coast: m/s^2 that it slows by during the delay.
        hold: m/s^2 with which it goes on braking for whom it brakes, until it no longer closes on him or he is out of
            its way; 0: it does as it demands.
    """

    name: str
    delay: float
    jerk: float
    coast: float
    hold: float

    def demand(self, e: Encounter) -> F64:
        """Braking that each other asks for, m/s^2; 0: there is no danger, or it is not perceived yet."""
        raise NotImplementedError


@dataclass(frozen=True)
class CarefulHuman(CarefulModel):
    """UN R157, Annex 4, Appendix 3: the careful and competent human driver.

    Attributes:
        wander: m across its lane that another may wander without a meaning.
        evaluate: m that it moves on while the driver judges it (0.4 s at 1.8 m/s).
        critical: TTC, s, below which the driver brakes.
        wait_for_overlap: Perceives a cut-in only once it is in the way, as in JRC's grids; else from the regulation's
            point on.
    """

    name: str = "cc"
    delay: float = 0.75
    jerk: float = JERK
    coast: float = 0.4
    hold: float = HARD
    wander: float = 0.375
    evaluate: float = 0.72
    critical: float = 2.0
    wait_for_overlap: bool = False

    def demand(self, e: Encounter) -> F64:
        """See `CarefulModel`."""
        comes = (e.moved > self.wander + self.evaluate) & (e.approach > 0.0) & (not self.wait_for_overlap)
        seen = (e.lateral <= 0.0) | comes
        return np.where(seen & e.ahead() & stays(e) & (e.time_to_reach() < self.critical), HARD, 0.0)


@dataclass(frozen=True)
class Reg157(CarefulModel):
    """UN R157, paragraph 5.2.5.2: the cut-in that a lane keeping system must survive.

    Attributes:
        brake: m/s^2, at once.
        margin: m between the bodies at which the other counts as in the lane: 0.3 m inside of its marking.
        spare: s added to the time that braking takes.
        reach: m that it sees.
    """

    name: str = "reg157"
    delay: float = 0.35
    jerk: float = np.inf
    coast: float = 0.0
    hold: float = 6.0
    brake: float = 6.0
    margin: float = 0.5
    spare: float = 0.1
    reach: float = 46.0

    def demand(self, e: Encounter) -> F64:
        """See `CarefulModel`."""
        inside = (e.lateral <= 0.0) | ((e.lateral <= self.margin) & (e.approach > 0.0))
        needs = e.closing() / (2.0 * self.brake) + self.delay + self.spare
        danger = inside & e.ahead() & stays(e) & (e.gap < self.reach) & (e.time_to_reach() < needs)
        return np.where(danger, self.brake, 0.0)


@dataclass(frozen=True)
class RSS(CarefulModel):
    """Responsibility-Sensitive Safety, with JRC's parameters.

    Brakes while the other is too near both along the path and across it (Shalev-Shwartz et al. 2017, definitions 1, 2
    and 6).

    Attributes:
        accelerate: m/s^2 that a driver may add during the delay.
        brake: m/s^2 that both sides are sure to reach.
        sideways: m/s^2, the same across the path, to add and to take away.
        wander: m across the path that bodies wander.
    """

    name: str = "rss"
    delay: float = 0.75
    jerk: float = np.inf
    coast: float = 0.0
    hold: float = HARD
    accelerate: float = 3.0
    brake: float = 6.0
    sideways: float = 1.0
    wander: float = 0.3

    def _runs(self, speed: F64, push: float, brake: float) -> F64:
        """How far a body goes that speeds up during the delay and then brakes, m."""
        after = speed + push * self.delay
        return (speed + 0.5 * push * self.delay) * self.delay + after * after / (2.0 * brake)

    def demand(self, e: Encounter) -> F64:
        """See `CarefulModel`."""
        own = self._runs(e.speed, self.accelerate, self.brake)
        leads = -e.lead * np.abs(e.lead) / (2.0 * self.brake)
        comes = self._runs(np.abs(e.lead), self.accelerate, self.brake)
        along = np.maximum(own + np.where(e.lead >= 0.0, leads, comes), 0.0)
        rest = self._runs(np.zeros_like(e.speed), self.sideways, self.sideways)
        across = self.wander + rest + self._runs(np.maximum(e.approach, 0.0), self.sideways, self.sideways)
        beside = (e.lateral <= 0.0) | ((e.lateral < across) & (e.approach > 0.0))
        danger = (e.gap < along) & beside & (e.gap > -e.length) & (e.speed > 0.0) & stays(e)
        return np.where(danger, HARD, 0.0)


@dataclass(frozen=True)
class FSM(CarefulModel):
    """The Fuzzy Safety Model: brakes a little where a stop would get tight, fully where it would not succeed.

    Attributes:
        least: m/s^2 of comfortable braking.
        most: m/s^2 of hard braking.
        leader: m/s^2 that whoever is ahead may brake with.
        margin: m that it keeps behind a stop.
    """

    name: str = "fsm"
    delay: float = 0.75
    jerk: float = JERK
    coast: float = 0.0
    hold: float = 0.0
    least: float = 4.0
    most: float = 6.0
    leader: float = 7.0
    margin: float = 2.0

    def demand(self, e: Encounter) -> F64:
        """See `CarefulModel`."""
        proactive, critical = self.proactive(e), self.critical(e)
        level = np.where(critical > 0.0, self.least + (self.most - self.least) * critical, self.least * proactive)
        misses = e.time_to_enter() > e.time_to_pass() + SPARE
        comes = (e.lateral <= 0.0) | (e.approach > 0.0)
        return np.where(comes & ~misses & (e.gap > -e.length) & stays(e), np.minimum(level, HARD), 0.0)

    def proactive(self, e: Encounter) -> F64:
        """PFS, 0 to 1: could the driver stop behind a leader that brakes?"""
        u, stop = e.speed, e.lead * np.abs(e.lead) / (2.0 * self.leader)
        safe = u * self.delay + u * u / (2.0 * self.least) - stop + self.margin
        unsafe = u * self.delay + u * u / (2.0 * self.most) - stop
        return _between(e.gap - self.margin, safe, unsafe)

    def critical(self, e: Encounter) -> F64:
        """CFS, 0 to 1: could the driver slow down to a leader that keeps its speed?"""
        u, lead, gap = e.speed, e.lead, e.gap
        accel = np.maximum(e.accel, -self.least)
        later = u + accel * self.delay
        braking = np.where(accel < 0.0, accel, -self.least)
        slower = (gap < (u - lead) ** 2 / (2.0 * np.abs(braking))).astype(np.float64)
        run = (0.5 * (u + later) - lead) * self.delay
        safe = run + (later - lead) ** 2 / (2.0 * self.least)
        unsafe = run + (later - lead) ** 2 / (2.0 * self.most)
        return np.where(u > lead, np.where(later < lead, slower, _between(gap, safe, unsafe)), 0.0)


def _between(gap: F64, safe: F64, unsafe: F64) -> F64:
    """0 above `safe`, 1 below `unsafe`, linear in between."""
    wide = np.where(safe > unsafe, safe - unsafe, 1.0)
    return np.where(gap >= safe, 0.0, np.where(gap <= unsafe, 1.0, (safe - gap) / wide))


def stays(e: Encounter) -> Bool:
    """Whether the other is not gone from the path by the time that the driver reaches it."""
    return np.asarray(e.time_to_leave() + SPARE > e.time_to_reach())


MODELS: dict[str, CarefulModel] = {m.name: m for m in (CarefulHuman(), Reg157(), RSS(), FSM())}


def careful_model(name: str) -> CarefulModel:
    """The model of that short name; raises UnknownNameError with the closest."""
    try:
        return MODELS[name]
    except KeyError:
        raise unknown_name("careful driver", name, MODELS) from None


@dataclass(frozen=True)
class Reaction:
    """What a model remembers.

    Attributes:
        since: s since each other has been perceived as a danger; negative: it is none.
        brake: m/s^2 that the driver brakes with now because of it.
    """

    since: F64
    brake: F64


def calm(shape: tuple[int, ...]) -> Reaction:
    """Nothing perceived, no braking."""
    return Reaction(np.full(shape, -1.0), np.zeros(shape))


def react(model: CarefulModel, e: Encounter, before: Reaction, dt: float) -> tuple[F64, Reaction]:
    """One step of a model.

    Args:
        model: The model.
        e: Everybody that the driver sees.
        before: What it remembered.
        dt: s of the step.

    Returns:
        Mean braking over the step that each other asks for, m/s^2, and what the model remembers now.
    """
    wants = model.demand(e)
    began = (before.since + dt > model.delay) & (before.since >= 0.0)
    if model.hold > 0.0:
        there = (e.lateral <= 0.0) | (e.approach > 0.0)
        wants = np.where(began & e.ahead() & there, np.maximum(wants, model.hold), wants)
    since = np.where(wants > 0.0, np.maximum(before.since, 0.0), -1.0)
    # braking may begin within the step
    share = np.clip((since + dt - model.delay) / dt, 0.0, 1.0)
    if np.isinf(model.jerk):
        brake = np.where(share > 0.0, wants, 0.0)
        mean = wants * share
    else:
        brake = np.where(share > 0.0, np.minimum(wants, before.brake + model.jerk * dt * share), 0.0)
        mean = 0.5 * (np.minimum(before.brake, wants) + brake)
    mean = np.where((since >= 0.0) & (share < 1.0), np.maximum(mean, model.coast), mean)
    return mean, Reaction(np.where(since >= 0.0, since + dt, -1.0), brake)
