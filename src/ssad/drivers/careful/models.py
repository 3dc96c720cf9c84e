"""Careful driver models of the regulation literature: the braking that each demands in an encounter.

Source: UN Regulation 157 (2021), Annex 4, Appendix 3 (careful and competent human driver) and paragraph 5.2.5.2;
Shalev-Shwartz et al. 2017 (RSS) with the parameters, and Mattas et al. 2020 and 2022 (Fuzzy Safety Model) with the
formulas, that the Joint Research Centre compares them with. SSAD applies the rules for cut-ins to
any agent that enters the path (see `Encounter`), and adds one rule: an agent that leaves the path before the driver
reaches it is no danger.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.errors import unknown_name
from ssad.core.types import F64, Bool
from ssad.drivers.careful.encounter import Encounter

HARD = 0.774 * 9.81  # m/s^2: emergency braking of a careful human (about 7.59)
JERK = HARD / 0.6  # m/s^3: full braking is reached after 0.6 s (about 12.65)
FOLLOWING_SPEEDS = np.array([7.2, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0]) / 3.6  # m/s, UN R157, paragraph 5.2.3.3
FOLLOWING_TIMES = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6])  # s, time gaps at these speeds
FOLLOWING_DISTANCE = 2.0  # m, minimum at any speed
SPARE = 0.1  # s between the departure of one agent from the conflict zone and the arrival of the other


@dataclass(frozen=True)
class CarefulModel:
    """Careful driver model: its demand for braking, and the dynamics of its response.

    Attributes:
        name: Its short name.
        delay: s from the perception of the danger to the first braking.
        jerk: Maximum growth of the braking, m/s^3; infinite: immediate.
        coast: Deceleration during the delay, m/s^2.
        hold: Minimum braking, m/s^2, once begun, until the gap no longer falls or the other leaves the path; 0: the
            demand alone decides.
    """

    name: str
    delay: float
    jerk: float
    coast: float
    hold: float

    def demand(self, encounter: Encounter) -> F64:
        """Return the braking that each other agent requires, m/s^2; 0: no danger, or not perceived yet."""
        raise NotImplementedError

    def following_gap(self, speed: F64) -> F64:
        """Return the gap, m, that the driver keeps behind a vehicle at its speed, m/s."""
        raise NotImplementedError


@dataclass(frozen=True)
class CarefulHuman(CarefulModel):
    """Careful and competent human driver of UN R157, Annex 4, Appendix 3.

    Attributes:
        wander: Lateral wandering of other vehicles that is ignored, m.
        evaluate: Lateral travel while the driver evaluates the risk, m (0.4 s at 1.8 m/s).
        critical: TTC below which the driver brakes, s.
        wait_for_overlap: Perceive a cut-in only once it is in the path, as in JRC's grids; else as in the regulation.
        headway: Time gap behind a vehicle, s.
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
    headway: float = 2.0

    def following_gap(self, speed: F64) -> F64:
        """Return the way of the headway, m."""
        return self.headway * speed

    def demand(self, encounter: Encounter) -> F64:
        """Brake hard below the critical TTC, once the other is perceived."""
        is_cutting_in = (
            (encounter.moved > self.wander + self.evaluate) & (encounter.approach > 0.0) & (not self.wait_for_overlap)
        )
        is_perceived = (encounter.lateral <= 0.0) | is_cutting_in
        return np.where(
            is_perceived & encounter.ahead() & stays_in_path(encounter) & (encounter.time_to_reach() < self.critical),
            HARD,
            0.0,
        )


@dataclass(frozen=True)
class Reg157(CarefulModel):
    """Lane keeping system of UN R157, paragraph 5.2.5.2, which must survive certain cut-ins.

    Attributes:
        brake: Braking, m/s^2, applied immediately.
        margin: Lateral distance at which the other counts as in the lane, m: 0.3 m inside of its marking.
        spare: Margin added to the braking time, s.
        reach: Sensor range, m.
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

    def following_gap(self, speed: F64) -> F64:
        """Return the minimum following distance of paragraph 5.2.3.3, m: a time gap by speed, but at least 2 m."""
        time_gap = np.interp(speed, FOLLOWING_SPEEDS, FOLLOWING_TIMES)
        return np.asarray(np.maximum(speed * time_gap, FOLLOWING_DISTANCE))

    def demand(self, encounter: Encounter) -> F64:
        """Brake once the TTC of a vehicle in the lane falls below the time that braking takes."""
        in_lane = (encounter.lateral <= 0.0) | ((encounter.lateral <= self.margin) & (encounter.approach > 0.0))
        required_time = encounter.closing() / (2.0 * self.brake) + self.delay + self.spare
        is_danger = (
            in_lane
            & encounter.ahead()
            & stays_in_path(encounter)
            & (encounter.gap < self.reach)
            & (encounter.time_to_reach() < required_time)
        )
        return np.where(is_danger, self.brake, 0.0)


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
        drifts: True if the driver itself may move towards the other during the delay, as in definition 6; False: it
            keeps its path, as in JRC's grids.
    """

    name: str = "rss"
    delay: float = 0.75
    jerk: float = JERK
    coast: float = 0.0
    hold: float = HARD
    accelerate: float = 3.0
    brake: float = 6.0
    sideways: float = 1.0
    wander: float = 0.3
    drifts: bool = True

    def following_gap(self, speed: F64) -> F64:
        """Return the gap, m, that is still safe after the leader has braked during the delay (JRC's `RSS_distance`)."""
        leader_speed = np.maximum(speed - self.brake * self.delay, 0.0)
        leader_distance = leader_speed * leader_speed / (2.0 * self.brake)
        return self._runs(speed, self.accelerate, self.brake) - leader_distance + 0.5 * self.brake * self.delay**2

    def _runs(self, speed: F64, acceleration: float, brake: float) -> F64:
        """Return the stopping distance, m, of a body that speeds up during the delay and then brakes."""
        final_speed = speed + acceleration * self.delay
        return (speed + 0.5 * acceleration * self.delay) * self.delay + final_speed * final_speed / (2.0 * brake)

    def demand(self, encounter: Encounter) -> F64:
        """Brake hard while both the longitudinal and the lateral distance are unsafe."""
        ego_distance = self._runs(encounter.speed, self.accelerate, self.brake)
        leader_distance = -encounter.lead * np.abs(encounter.lead) / (2.0 * self.brake)
        oncoming_distance = self._runs(np.abs(encounter.lead), self.accelerate, self.brake)
        safe_gap = np.maximum(ego_distance + np.where(encounter.lead >= 0.0, leader_distance, oncoming_distance), 0.0)
        safe_lateral = self.wander + self._runs(np.maximum(encounter.approach, 0.0), self.sideways, self.sideways)
        if self.drifts:
            safe_lateral = safe_lateral + self._runs(np.zeros_like(encounter.speed), self.sideways, self.sideways)
        is_beside = (encounter.lateral <= 0.0) | ((encounter.lateral < safe_lateral) & (encounter.approach > 0.0))
        is_danger = (
            (encounter.gap < safe_gap)
            & is_beside
            & (encounter.gap > -encounter.length)
            & (encounter.speed > 0.0)
            & stays_in_path(encounter)
        )
        return np.where(is_danger, HARD, 0.0)


@dataclass(frozen=True)
class FSM(CarefulModel):
    """Fuzzy Safety Model: brakes gently where a stop gets tight, hard where it would not succeed.

    Attributes:
        gentle_braking: Comfortable braking, m/s^2.
        hard_braking: Hard braking, m/s^2.
        leader: Assumed braking of the leader, m/s^2.
        margin: Standstill gap, m.
    """

    name: str = "fsm"
    delay: float = 0.75
    jerk: float = JERK
    coast: float = 0.0
    hold: float = 0.0
    gentle_braking: float = 4.0
    hard_braking: float = 6.0
    leader: float = 7.0
    margin: float = 2.0

    def following_gap(self, speed: F64) -> F64:
        """Return the smallest gap, m, at which the proactive score is 0 behind a leader of the same speed."""
        stop = speed * speed / (2.0 * self.gentle_braking) - speed * speed / (2.0 * self.leader)
        return speed * self.delay + stop + 2.0 * self.margin

    def demand(self, encounter: Encounter) -> F64:
        """Brake according to the critical fuzzy score, else the proactive one."""
        proactive, critical = self.proactive(encounter), self.critical(encounter)
        level = np.where(
            critical > 0.0,
            self.gentle_braking + (self.hard_braking - self.gentle_braking) * critical,
            self.gentle_braking * proactive,
        )
        passes_before = encounter.time_to_enter() > encounter.time_to_pass() + SPARE
        is_relevant = (encounter.lateral <= 0.0) | (encounter.approach > 0.0)
        return np.where(
            is_relevant & ~passes_before & (encounter.gap > -encounter.length) & stays_in_path(encounter),
            np.minimum(level, HARD),
            0.0,
        )

    def proactive(self, encounter: Encounter) -> F64:
        """PFS, 0 to 1: could the driver stop behind a leader that brakes?"""
        speed, leader_stop = encounter.speed, encounter.lead * np.abs(encounter.lead) / (2.0 * self.leader)
        safe = speed * self.delay + speed * speed / (2.0 * self.gentle_braking) - leader_stop + self.margin
        unsafe = speed * self.delay + speed * speed / (2.0 * self.hard_braking) - leader_stop
        return _danger_level(encounter.gap - self.margin, safe, unsafe)

    def critical(self, encounter: Encounter) -> F64:
        """CFS, 0 to 1: could the driver slow down to a leader that keeps its speed?"""
        speed, lead_speed, gap = encounter.speed, encounter.lead, encounter.gap
        acceleration = np.maximum(encounter.accel, -self.gentle_braking)
        final_speed = speed + acceleration * self.delay
        braking = np.where(acceleration < 0.0, acceleration, -self.gentle_braking)
        is_critical = (gap < (speed - lead_speed) ** 2 / (2.0 * np.abs(braking))).astype(np.float64)
        delay_distance = (0.5 * (speed + final_speed) - lead_speed) * self.delay
        safe = delay_distance + (final_speed - lead_speed) ** 2 / (2.0 * self.gentle_braking)
        unsafe = delay_distance + (final_speed - lead_speed) ** 2 / (2.0 * self.hard_braking)
        return np.where(
            speed > lead_speed, np.where(final_speed < lead_speed, is_critical, _danger_level(gap, safe, unsafe)), 0.0
        )


def _danger_level(gap: F64, safe: F64, unsafe: F64) -> F64:
    """Return 0 above `safe`, 1 below `unsafe`, linear in between."""
    width = np.where(safe > unsafe, safe - unsafe, 1.0)
    return np.where(gap >= safe, 0.0, np.where(gap <= unsafe, 1.0, (safe - gap) / width))


def stays_in_path(encounter: Encounter) -> Bool:
    """Return True where the other agent is still in the path when the driver reaches it."""
    # an agent that never leaves stays, also before a driver that never reaches it
    time_to_leave = encounter.time_to_leave()
    return np.isinf(time_to_leave) | (time_to_leave + SPARE > encounter.time_to_reach())


MODELS: dict[str, CarefulModel] = {m.name: m for m in (CarefulHuman(), Reg157(), RSS(), FSM())}


def careful_model(name: str) -> CarefulModel:
    """Return the model of a short name. UnknownNameError lists the closest names."""
    try:
        return MODELS[name]
    except KeyError:
        raise unknown_name("careful driver", name, MODELS) from None


@dataclass(frozen=True)
class Reaction:
    """Memory of a model.

    Attributes:
        since: Time since each other agent became a danger, s; negative: no danger.
        brake: Current braking because of it, m/s^2.
    """

    since: F64
    brake: F64


def initial_reaction(shape: tuple[int, ...]) -> Reaction:
    """Return the memory without danger and braking."""
    return Reaction(np.full(shape, -1.0), np.zeros(shape))


def react(model: CarefulModel, encounter: Encounter, previous: Reaction, dt: float) -> tuple[F64, Reaction]:
    """One step of a model.

    Args:
        model: The model.
        encounter: Everybody that the driver sees.
        previous: What it remembered.
        dt: s of the step.

    Returns:
        Mean braking over the step that each other asks for, m/s^2, and what the model remembers now.
    """
    demanded = model.demand(encounter)
    is_braking = (previous.since + dt > model.delay) & (previous.since >= 0.0)
    if model.hold > 0.0:
        is_relevant = (encounter.lateral <= 0.0) | (encounter.approach > 0.0)
        demanded = np.where(is_braking & encounter.ahead() & is_relevant, np.maximum(demanded, model.hold), demanded)
    since = np.where(demanded > 0.0, np.maximum(previous.since, 0.0), -1.0)
    # the delay may end within the step
    share = np.clip((since + dt - model.delay) / dt, 0.0, 1.0)
    if np.isinf(model.jerk):
        brake = np.where(share > 0.0, demanded, 0.0)
        mean_braking = demanded * share
    else:
        brake = np.where(share > 0.0, np.minimum(demanded, previous.brake + model.jerk * dt * share), 0.0)
        mean_braking = 0.5 * (np.minimum(previous.brake, demanded) + brake)
    mean_braking = np.where((since >= 0.0) & (share < 1.0), np.maximum(mean_braking, model.coast), mean_braking)
    return mean_braking, Reaction(np.where(since >= 0.0, since + dt, -1.0), brake)
