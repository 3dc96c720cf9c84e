"""Collisions of trainings of Adv.PPO that a careful driver avoids: the table of docs/results/learned-adversaries.md.

`python -m benchmarks.avoidable all` trains each variant of `TRIALS` with the recipe of `ssad train adversary`, about
two minutes of processor time each, lets it loose on 120 scenarios of random towns that no set uses, against the
Autopilot and PPO, and keeps what came of it in benchmarks/results/avoidable.json; names instead of `all` measure
these again, and `--page` writes the table of what is there. What is told apart: who learns from what (`plan`), and who
becomes an adversary or where its goal lies, in training and after (`select`, `goal`), for which there is no option.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp

from benchmarks.make_scenario_sets import with_crossing_traffic
from ssad.core.driving import Choice, Driver, WorldState
from ssad.core.generators import Base, Proposal
from ssad.core.geometry import to_local
from ssad.core.rotations import wrap_angle
from ssad.core.types import Bool, Scenario
from ssad.drivers import make_system
from ssad.drivers.careful.driver import Careful
from ssad.drivers.careful.grade import AFTER, _ReplayObserver, danger_start
from ssad.drivers.careful.replay import ReplayPlan, Takeover, run_replays
from ssad.metrics import CaseValue, estimate
from ssad.metrics.driving import first_contact
from ssad.scenarios.dynamic.generate import Trials, scenario_of
from ssad.scenarios.dynamic.policy.adv_ppo import Adversary
from ssad.simulators.proofs import prove_collisions
from ssad.training.adversary import ROAD_COST, AdversaryPlan, run_adversary_training
from ssad.world.roads import load_town
from ssad.world.selection import FreaSelection, Note

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "avoidable.json"
DOCUMENT = ROOT / "docs" / "results" / "learned-adversaries.md"
BEGIN, END = "<!-- trials: begin -->", "<!-- trials: end -->"
TOWNS = {"Random21": 12, "Random24": 12, "Random25": 12, "Random3": 12, "Random5": 12}
"""Town -> number of junction routes; the first three have two lanes a direction."""
SCENARIOS, SEED = 120, 2_000_003
EGOS = ("autopilot", "ppo")
STANDS = 0.5  # m/s


@dataclass(frozen=True)
class Picky(FreaSelection):
    """FREA's choice among fewer.

    Attributes:
        while_above: Nobody is chosen while the ego is not faster, m/s.
        let_go_at: Whoever is chosen is let go when the ego is no faster, m/s.
        turn: Nobody is chosen whose heading differs more from the ego's, rad.
        behind: Whether those behind the ego can be chosen.
    """

    while_above: float = -np.inf
    let_go_at: float = -np.inf
    turn: float = np.inf
    behind: bool = True

    def __call__(self, state: WorldState) -> Choice:
        choice = super().__call__(state)
        stays = choice.agents & (state.speed[:, :1] > self.let_go_at)
        return replace(choice, agents=stays, note=np.where(stays, choice.note, choice.note & ~int(Note.CHOSEN)))

    def _candidates(self, state: WorldState) -> Bool:
        turn = np.abs(wrap_angle(state.pose[..., 2] - state.pose[:, :1, 2]))
        can = super()._candidates(state) & (state.speed[:, :1] > self.while_above) & (turn <= self.turn)
        x = to_local(state.pose[:, :1], state.pose[..., :2])[..., 0]
        return np.asarray(can if self.behind else can & (x >= 0.0))


@dataclass(frozen=True)
class Trial:
    """A training.

    Attributes:
        says: What is different.
        plan: Fields of `AdversaryPlan`; None: the shipped weights.
        select: Fields of `Picky`.
        goal: How far ahead of the ego the goal lies, m.
    """

    says: str
    plan: dict[str, Any] | None = field(default_factory=dict)
    select: dict[str, Any] = field(default_factory=dict)
    goal: float = 6.5


def _set(**changes: Any) -> dict[str, Any]:
    return {"changes": tuple(changes.items())}


LANES = {"scenarios": ("training-lanes",)}
TRIALS = {
    "shipped": Trial("shipped weights", None),
    "seed-1": Trial("seed 1", _set(seed=1)),
    "ego-ppo": Trial("trained against `ppo`", {"ego": "ppo"}),
    "ego-sac": Trial("trained against `sac`", {"ego": "sac"}),
    "ego-blind": Trial("trained against `blind`", {"ego": "blind"}),
    "moving": Trial("chosen only while the ego is faster than 4 m/s", select={"while_above": 4.0}),
    "goal-10": Trial("goal 10 m ahead of the ego instead of 6.5 m", goal=10.0),
    "goal-lanes": Trial("goal 10 m ahead, learned in `training-lanes`", LANES, goal=10.0),
    "goal-4": Trial("goal 4 m ahead", goal=4.0),
    "brake": Trial("a brake instead of reverse", _set(action="pedals")),
    "let-go": Trial(
        "chosen while the ego is faster than 2 m/s, let go below 1 m/s", select={"while_above": 2.0, "let_go_at": 1.0}
    ),
    "not-oncoming": Trial("no oncoming vehicles", select={"turn": float(np.radians(120.0))}),
    "radius": Trial("chosen within 40 m instead of 25 m", select={"radius": 40.0}),
    "ego-td3": Trial("trained against `td3`", {"ego": "td3"}),
    "lanes": Trial("learned in `training-lanes`", LANES),
    "lanes-ppo": Trial("learned there against `ppo`", LANES | {"ego": "ppo"}),
    "discount": Trial("discount 0.95", _set(gamma=0.95)),
    "seed-2": Trial("seed 2", _set(seed=2)),
    "road-2": Trial("2 for a step off the road instead of 0.5", {"off_road": 2.0}),
}
"""By the name that it is kept under."""


@contextmanager
def goal_ahead(distance: float) -> Iterator[None]:
    """The goal lies elsewhere: for the reward, the choice, and what adversaries see."""
    kernels = wp.get_module("ssad.world.kernels.look")
    with (
        patch("ssad.world.rewards.GOAL_AHEAD", distance),
        patch("ssad.world.selection.GOAL_AHEAD", distance),
        patch("ssad.world.kernels.look.GOAL_AHEAD", wp.constant(distance)),
    ):
        kernels.mark_modified()
        yield
    kernels.mark_modified()


def run(trial: Trial) -> dict[str, Any]:
    """Train a trial, and let it loose on each ego."""
    selection = Picky(count=1, **trial.select)
    with ExitStack() as stack:
        stack.enter_context(goal_ahead(trial.goal))
        for module in ("adversary", "adversary_env"):
            stack.enter_context(patch(f"ssad.training.{module}.FreaSelection", lambda count: selection))
        if trial.plan is None:
            driver: Driver = Adversary(name="adv-ppo-paper")
        else:
            out = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            plan = AdversaryPlan("adv-ppo-paper", out, test=(), **{"off_road": ROAD_COST} | trial.plan)
            list(run_adversary_training(plan, report=lambda _: None))
            driver = Adversary(out / "adv-ppo-paper.safetensors")
        return {ego: measure(driver, selection, ego) for ego in EGOS}


def measure(driver: Driver, selection: FreaSelection, ego: str) -> dict[str, Any]:
    """What an adversary does to an ego.

    Returns:
        Of each scenario that the ego survives as it is: whether it collides with anybody, whether with an adversary
        that stayed on the road and hit nobody else, and whether that is proven; and of each such collision that
        happens again in the saved scenario: whether R157 avoids it, whether the ego moves, how far ahead of the ego
        the other is, m, and by how much its heading differs, rad.
    """
    trials = Trials(lambda: make_system(ego), policies=make_system)
    graphs = {town: load_town(town) for town in TOWNS}
    bases = trials.bases([(s, graphs[s.town], SEED + k) for k, s in enumerate(held_out())])
    alive = [base for base in bases if base.trace.end != "collision"]
    found = trials.run([(base, Proposal(base.scenario, drivers={selection: driver})) for base in alive])
    proofs = prove_collisions(list(zip(alive, found, strict=True)), trials)
    rows = {
        base.scenario.name: [
            float(o.trace is not None and o.trace.end == "collision"),
            float(o.is_valid),
            float(proven),
        ]
        for base, o, proven in zip(alive, found, proofs, strict=True)
    }
    made = [
        (scenario_of(o, base, name=base.scenario.name), base.graph, base.episode.seed + 1)
        for base, o in zip(alive, found, strict=True)
        if o.is_valid
    ]
    again = [base for base in trials.bases(made) if base.trace.end == "collision"] if made else []
    collisions: dict[str, list[float]] = {}
    for base, clear in zip(again, reg157_avoids(again), strict=True):
        trace, (step, agent) = base.trace, first_contact(base.trace)
        pose = np.stack([trace.x[step], trace.y[step], trace.yaw[step]], -1)
        ahead = float(to_local(pose[0], pose[agent, :2])[0])
        turn = float(wrap_angle(pose[agent, 2] - pose[0, 2]))
        moves = abs(float(trace.speed[step, 0])) > STANDS
        collisions[base.scenario.name] = [float(clear), float(moves), round(ahead, 1), round(turn, 2)]
    return {"rows": rows, "collisions": collisions}


@cache
def held_out() -> list[Scenario]:
    """Where the adversaries are tried out."""
    return with_crossing_traffic(TOWNS, SCENARIOS)


def reg157_avoids(collisions: Sequence[Base]) -> list[bool]:
    """As `grade_collisions`, without the other careful drivers and the manoeuvres, which take most of its time."""
    drives = [(base.episode, base.graph, base.trace) for base in collisions]
    contacts = [first_contact(trace) for _, _, trace in drives]
    ends = [step * trace.dt for (step, _), (_, _, trace) in zip(contacts, drives, strict=True)]
    watch = _ReplayObserver(drives, [agent for _, agent in contacts])
    nobody, endings = Takeover(Careful(), math.inf), []
    run_replays([ReplayPlan(*drive, [nobody], end) for drive, end in zip(drives, ends, strict=True)], watch=watch)
    for k, (drive, (step, agent), end) in enumerate(zip(drives, contacts, ends, strict=True)):
        trace = drive[2]
        begin = danger_start(trace, agent, step, watch.triggered[k, : len(trace.x)], watch.seen[k, : len(trace.x)])
        driver = Careful("reg157", keep_speed=True)
        endings.append(ReplayPlan(*drive, [Takeover(driver, begin * trace.dt)], end + AFTER))
    return [not bool(hits[0]) for hits in run_replays(endings)] if endings else []


def cluster(name: str) -> str:
    """A scenario, or the route of one with random traffic."""
    return re.sub(r"^(natural[\w-]*/\w+)/\d+$", r"\1", name)


def share(values: dict[str, float]) -> str:
    """A share with its interval; the draws of a route are one cluster."""
    if not values:
        return ""
    found = estimate([CaseValue(value, cluster(name), name) for name, value in values.items()], "bounded")
    return f"{found.mean:.2f} [{found.low:.2f}, {found.high:.2f}]"


def table(data: dict[str, Any]) -> list[str]:
    """Of each ego, a row for each trial."""
    lines = []
    for ego in EGOS:
        measured = {name: data[name][ego] for name in TRIALS if name in data}
        survived = len(next(iter(measured.values()))["rows"])
        # Trials that were measured before proofs were have two columns.
        is_proven = any(len(row) > 2 for trial in measured.values() for row in trial["rows"].values())
        shares = {"proven": 2, "any collision": 0, "CR": 1} if is_proven else {"any collision": 0, "CR": 1}
        lines += [
            f"`{ego}`, which survives {survived} of {SCENARIOS} scenarios in plain replay:",
            "",
            f"| Adv.PPO | {' | '.join(shares)} | graded | R157 avoids | ego moves | hit from behind | oncoming |",
            f"|---{'|---' * len(shares)}|---:|---|---:|---:|---:|",
        ]
        for name, one in measured.items():
            rows, hits = one["rows"], one["collisions"]
            parts = [
                share({who: row[column] for who, row in rows.items() if len(row) > column}) or "n/a"
                for column in shares.values()
            ]
            kinds: Sequence[Any] = [
                [row[1] for row in hits.values()],
                [row[2] < -2.0 for row in hits.values()],
                [abs(row[3]) > np.radians(120.0) for row in hits.values()],
            ]
            means = [f"{np.mean(kind):.2f}" if hits else "" for kind in kinds]
            avoided = share({who: row[0] for who, row in hits.items()})
            lines.append(f"| {' | '.join([TRIALS[name].says, *parts, str(len(hits)), avoided, *means])} |")
        lines.append("")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("trials", nargs="*", help="names, or all: those that are not kept yet")
    parser.add_argument("--page", action="store_true", help="write docs/results/learned-adversaries.md")
    given = parser.parse_args()
    data: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    names = [name for name in TRIALS if name not in data] if given.trials == ["all"] else given.trials
    for name in names:
        start = time.process_time()
        data[name] = run(TRIALS[name])
        RESULTS.write_text(json.dumps(data, separators=(",", ":")) + "\n")
        print(f"{name}: {time.process_time() - start:.0f} s", flush=True)
    print("\n".join(table(data)))
    if given.page:
        before, _, rest = DOCUMENT.read_text().partition(BEGIN)
        DOCUMENT.write_text("\n".join([before + BEGIN, *table(data), END + rest.partition(END)[2]]))


if __name__ == "__main__":
    main()
