"""Does an ego that was trained on generated scenarios collide less? Generated, trained and tested anew, with intervals.

    python -m benchmarks.retraining --out DIR --workers 8        # resumes what DIR has; also --small, --tiny
    python -m benchmarks.retraining --page                       # the table of docs/results/retraining.md

1. `before`: PPO on the set `training`, with several seeds.
2. Generators search for collisions of these egos: in the bases of `training` to learn from, in those of `precrash` and
   `natural` (other towns) to test on. Each base is searched against one of the egos, and only collisions count in which
   the ego moves, and the adversary stays on the road and touches nobody else.
3. `after`: each ego trained further on `training` and on what was found there. `control`: as long, on `training` alone.
4. All drive what was found in the other towns, but nobody what was found against the same seed: an ego collides in that
   by selection. They also drive natural traffic and the pre-crash set as they are, and are attacked anew.

Each base scenario is a cluster, in natural traffic each route; its value is the mean over seeds, and differences are
paired by base.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "retraining.json"
DOCUMENT = ROOT / "docs" / "results" / "retraining.md"
BEGIN, END = "<!-- retraining: begin -->", "<!-- retraining: end -->"
ARMS = ("before", "control", "after")
LEARN, HELD = ("training",), ("precrash", "natural")
PLAIN = ("precrash", "natural", "natural-unselected")
ATTACKS = {"bayesian": ("precrash", 1), "adv-ppo": ("natural", 2)}
"""Generator -> the set in which it attacks the egos anew, and of that each so-many-th scenario."""


@dataclass(frozen=True, slots=True)
class Size:
    """How much is done.

    Attributes:
        seeds: Egos.
        steps: Of each training.
        generators: What searches.
        budget: Rollouts of each search.
        every: Only each so-many-th scenario of the sets.
        attack: Whether the egos are also attacked anew.
        changes: Further values of the recipe.
    """

    seeds: int = 4
    steps: int = 1_000_000
    generators: tuple[str, ...] = ("bayesian", "king", "adv-ppo")
    budget: int = 16
    every: int = 1
    attack: bool = True
    changes: tuple[tuple[str, Any], ...] = ()


SMALL = Size(
    seeds=2,
    steps=300_000,
    generators=("bayesian", "adv-ppo"),
    budget=8,
    every=2,
    attack=False,
    changes=(("validate", 150_000),),
)
TINY = Size(
    seeds=2,
    steps=2048,
    generators=("random", "adv-ppo"),
    budget=4,
    every=16,
    changes=(("scenes", 16), ("rollout", 64), ("batch", 256), ("validate", 1024), ("draws", 1)),
)


def scenarios_of(refs: Sequence[str], every: int) -> tuple[list[Any], dict[str, Any]]:
    """Scenarios of some sets and files, and the lane graphs of their towns."""
    from ssad.training.driver import find_scenarios

    found, graphs = find_scenarios(refs)
    return found[::every], graphs


def ego(out: Path, arm: str, seed: int) -> str:
    """Name of an ego as a driving system."""
    return f"ppo:{out / f'{arm}-{seed}' / 'ppo.safetensors'}"


def train(out: Path, size: Size, arm: str, seed: int) -> None:
    """Train one ego."""
    from ssad.training.driver import DriverPlan, run_driver_training

    refs = [*LEARN, *(found_files(out, "learn", size) if arm == "after" else [])]
    changes = {**dict(size.changes), "steps": size.steps, "seed": seed if arm == "before" else 100 + seed}
    plan = DriverPlan(
        "ppo",
        out / f"{arm}-{seed}",
        tuple(refs),
        (),
        tuple(changes.items()),
        start=None if arm == "before" else out / f"before-{seed}",
    )
    for line in run_driver_training(plan, report=lambda text: None):
        print(arm, seed, line.rpartition("/")[2], flush=True)


def found_files(out: Path, part: str, size: Size) -> list[str]:
    """Files of found scenarios that are not empty."""
    names = [out / "found" / f"{part}-{g}-{s}.yaml" for g in size.generators for s in range(size.seeds)]
    return [str(path) for path in names if path.is_file()]


def hunt(out: Path, size: Size, generator: str, seed: int, part: str) -> None:
    """Search the bases that fall to one ego, and save the distinct collisions."""
    from ssad.core.types import MOVING
    from ssad.experiments.adversarial.search_scores import distinct_collisions
    from ssad.scenarios.dynamic import save_scenarios
    from ssad.scenarios.dynamic.generate import scenario_of

    scenarios, graphs = scenarios_of(LEARN if part == "learn" else HELD, size.every)
    if generator != "adv-ppo":  # parameters of natural traffic hardly matter
        scenarios = [s for s in scenarios if s.traffic is None and s.type != "NaturalJunction"]
    bases, rows = search_all(
        ego(out, "before", seed), generator, scenarios[seed :: size.seeds], graphs, seed=seed, budget=size.budget
    )
    made, hits = [], 0
    for base, row in zip(bases, rows, strict=True):
        good = [o for o in row if o.valid and o.ego_speed is not None and o.ego_speed > MOVING]
        hits += bool(good)
        for n, outcome in enumerate(distinct_collisions(good)[:3]):
            made.append(scenario_of(outcome, base, name=f"{base.scenario.name}/{generator}-{n}-ego-{seed}"))
    if made:
        save_scenarios(out / "found" / f"{part}-{generator}-{seed}.yaml", made)
    note = {"bases": len(bases), "hits": hits, "saved": len(made)}
    (out / "found" / f"{part}-{generator}-{seed}.json").write_text(json.dumps(note))


def search_all(
    system: str, generator: str, scenarios: Sequence[Any], graphs: Any, *, seed: int, budget: int
) -> tuple[list[Any], list[Any]]:
    """Bases that a system survives and a generator can change, and the outcomes of each."""
    from ssad.drivers import make_system
    from ssad.experiments.adversarial.found_collisions import refusal_reason
    from ssad.scenarios.dynamic.generate import Trials, generator_factory, search

    trials = Trials(lambda: make_system(system), make_system)
    factory = generator_factory(generator)
    bases = [trials.base(scenario, graphs[scenario.town], seed=seed) for scenario in scenarios]
    bases = [base for base in bases if base.trace.end != "collision" and not refusal_reason(factory, base.episode)]
    if not bases:
        return [], []
    made = factory(bases, seeds=[seed] * len(bases), budget=budget)
    return bases, search(made, bases, trials, budget=budget)


def drive(out: Path, size: Size, arm: str, seed: int) -> None:
    """Collisions of one ego in what was found in other towns, and in plain sets; what it meets when attacked anew."""
    from ssad.drivers import make_system
    from ssad.metrics import episode_metrics
    from ssad.training.driver import draw_episodes
    from ssad.world.rollout import rollout
    from ssad.world.world import World

    system = ego(out, arm, seed)
    found: dict[str, Any] = {"plain": {}, "found": {}, "attack": {}}
    parts = {name: [name] for name in PLAIN}
    parts["found"] = found_files(out, "held", size)
    for name, refs in parts.items():
        if not refs:
            continue
        scenarios, graphs = scenarios_of(refs, 1 if name == "found" else size.every)
        episodes = draw_episodes(scenarios, graphs, draws=1, seed=0)
        rows: dict[str, list[float]] = {}
        for first in range(0, len(episodes), 64):
            part = episodes[first : first + 64]
            for episode, trace in zip(part, rollout(World(part, graphs), make_system(system)), strict=True):
                row = episode_metrics(trace)
                off = row.off_road / row.driven if row.driven else 0.0
                rows[episode.scenario.name] = [float(row.collision), row.route_completion, off]
        found["found" if name == "found" else "plain"] |= {name: rows}
    for generator, (where, every) in ATTACKS.items() if size.attack else ():
        scenarios, graphs = scenarios_of([where], max(size.every, every))
        bases, outcomes = search_all(system, generator, scenarios, graphs, seed=1000 + seed, budget=size.budget)
        hit = {base.scenario.name: any(o.valid for o in row) for base, row in zip(bases, outcomes, strict=True)}
        # who collides in the base itself was broken without an attack
        found["attack"][generator] = {s.name: float(hit.get(s.name, True)) for s in scenarios}
    (out / f"drive-{arm}-{seed}.json").write_text(json.dumps(found))


def stages(out: Path, size: Size) -> list[list[tuple[Path, Callable[..., None], tuple[Any, ...]]]]:
    """Tasks that can run side by side, stage after stage: what each writes, its function, its arguments."""
    seeds = range(size.seeds)

    def trainings(arm: str) -> list[tuple[Path, Callable[..., None], tuple[Any, ...]]]:
        return [(out / f"{arm}-{s}" / "ppo.safetensors", train, (arm, s)) for s in seeds]

    hunts: list[tuple[Path, Callable[..., None], tuple[Any, ...]]] = [
        (out / "found" / f"{part}-{g}-{s}.json", hunt, (g, s, part))
        for g in sorted(size.generators, key=lambda g: g != "king")  # the longest first
        for part in ("learn", "held")
        for s in seeds
    ]
    drives: list[tuple[Path, Callable[..., None], tuple[Any, ...]]] = [
        (out / f"drive-{arm}-{s}.json", drive, (arm, s)) for s in seeds for arm in ARMS
    ]
    return [trainings("before"), hunts, trainings("after") + trainings("control"), drives]


def work(out: Path, size: Size, function: Callable[..., None], arguments: tuple[Any, ...]) -> float:
    """One task; its processor time, s."""
    import torch

    from ssad.core.machine import start_warp_quietly

    start_warp_quietly()
    torch.set_num_threads(1)
    began = time.process_time()
    function(out, size, *arguments)
    return time.process_time() - began


def gather(out: Path, size: Size) -> dict[str, Any]:
    """All results in one: by base scenario, arm and seed."""
    data: dict[str, Any] = {
        "size": {"seeds": size.seeds, "steps": size.steps, "generators": list(size.generators), "budget": size.budget}
    }
    data["hunts"] = {
        path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted((out / "found").glob("*.json"))
    }
    paths = {(arm, s): out / f"drive-{arm}-{s}.json" for arm in ARMS for s in range(size.seeds)}
    seeds = [s for s in range(size.seeds) if all(paths[arm, s].is_file() for arm in ARMS)]
    rows = {(arm, s): json.loads(paths[arm, s].read_text(encoding="utf-8")) for arm in ARMS for s in seeds}
    data["size"]["seeds"] = len(seeds)
    first = rows["before", seeds[0]]
    data["plain"], data["attack"] = {}, {}
    for name, table in first["plain"].items():
        data["plain"][name] = {arm: {k: [rows[arm, s]["plain"][name][k] for s in seeds] for k in table} for arm in ARMS}
    for name, table in first["attack"].items():
        data["attack"][name] = {
            arm: {k: [rows[arm, s]["attack"][name][k] for s in seeds] for k in table} for arm in ARMS
        }
    data["found"] = {
        arm: {
            k: [rows[arm, s]["found"]["found"][k][0] if own(k) != s else None for s in seeds]
            for k in first["found"].get("found", {})
        }
        for arm in ARMS
    }
    return data


def own(name: str) -> int:
    """The ego against which a scenario was found."""
    return int(name.rpartition("-ego-")[2])


def cases(values: dict[str, list[Any]], column: int | None = None) -> dict[str, Any]:
    """Return a mean over seeds for each scenario; its cluster is the base scenario, or the route of natural traffic."""
    from benchmarks.avoidable import cluster
    from ssad.metrics import CaseValue

    found = {}
    for name, row in values.items():
        kept = [v if column is None else v[column] for v in row if v is not None]
        if not kept:
            continue
        base = "/".join(name.split("/")[:-1]) if "-ego-" in name else name
        found[name] = CaseValue(float(np.mean(kept)), cluster(base), name)
    return found


def table(data: dict[str, Any]) -> list[str]:
    """What each arm does where, and how much less than before and than the control."""
    from ssad.metrics import Estimate, estimate, paired_difference
    from ssad.metrics.intervals import MIN_ROUTES

    def text(found: Estimate, *, sign: bool = False) -> str:
        form = "+.3f" if sign else ".3f"
        if found.method == "range":
            return f"{found.mean:{form}} ({found.low:{form}} to {found.high:{form}} over {found.clusters} clusters)"
        return f"{found.mean:{form}} [{found.low:{form}}, {found.high:{form}}]"

    def line(what: str, part: dict[str, Any], column: int | None = None) -> str:
        arms = {arm: cases(part[arm], column) for arm in ARMS}
        shown = [text(estimate(arms[arm].values(), "bounded", min_clusters=MIN_ROUTES)) for arm in ARMS]
        differences = [
            text(paired_difference(arms["after"], arms[arm], min_clusters=MIN_ROUTES), sign=True)
            for arm in ("before", "control")
        ]
        wins = sum(
            (mean_of(part["after"], s, column) or 0.0) < (mean_of(part["before"], s, column) or 0.0)
            for s in range(data["size"]["seeds"])
        )
        count = len(arms["before"])
        return f"| {what} | {count} | {' | '.join([*shown, *differences])} | {wins} of {data['size']['seeds']} |"

    lines = [
        "| | scenarios | before | control | after | after - before | after - control | seeds that fall |",
        "|---|---:|---|---|---|---|---|---:|",
    ]
    kinds = sorted(
        {name.rpartition("/")[2].rpartition("-ego-")[0].rpartition("-")[0] for name in data["found"]["after"]}
    )
    lines.append(line("CR, found in other towns", data["found"]))
    for kind in kinds:
        part = {arm: {k: v for k, v in data["found"][arm].items() if f"/{kind}-" in k} for arm in ARMS}
        lines.append(line(f"CR, of these by `{kind}`", part))
    for generator, part in data["attack"].items():
        lines.append(line(f"broken by `{generator}` anew, `{ATTACKS[generator][0]}`", part))
    for name, part in data["plain"].items():
        lines += [line(f"CR, `{name}`", part, 0), line(f"RC, `{name}`", part, 1)]
    return [*lines, ""]


def mean_of(values: dict[str, list[Any]], seed: int, column: int | None) -> float | None:
    """Mean of one seed over scenarios."""
    kept = [row[seed] if column is None else row[seed][column] for row in values.values() if row[seed] is not None]
    return float(np.mean(kept)) if kept else None


def keep(given: argparse.Namespace, size: Size) -> None:
    """Write what is there of the seeds whose three arms have driven."""
    if any(all((given.out / f"drive-{arm}-{s}.json").is_file() for arm in ARMS) for s in range(size.seeds)):
        given.json.write_text(json.dumps(gather(given.out, size), separators=(",", ":")) + "\n", encoding="utf-8")


def main() -> None:
    """Run what is missing, keep, and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--small", action="store_true", help="half an hour of one core")
    parser.add_argument("--tiny", action="store_true", help="only to try it")
    parser.add_argument("--json", type=Path, default=RESULTS)
    parser.add_argument("--page", action="store_true", help="write docs/results/retraining.md")
    given = parser.parse_args()
    size = TINY if given.tiny else SMALL if given.small else Size(seeds=given.seeds, steps=given.steps)
    if given.out is not None:
        (given.out / "found").mkdir(parents=True, exist_ok=True)
        began = time.perf_counter()
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(given.workers, mp_context=context) as pool:
            for number, tasks in enumerate(stages(given.out, size)):
                waiting = {
                    pool.submit(work, given.out, size, function, arguments): arguments
                    for path, function, arguments in tasks
                    if not path.is_file()
                }
                spent = 0.0
                for done in as_completed(waiting):
                    spent += done.result()
                    took = time.perf_counter() - began
                    print(f"{took:.0f} s: stage {number}: {waiting[done]}, {spent:.0f} s of processor", flush=True)
                    keep(given, size)
        keep(given, size)
    data = json.loads(given.json.read_text(encoding="utf-8"))
    print("\n".join(table(data)))
    if given.page:
        whole = DOCUMENT.read_text(encoding="utf-8")
        before, _, rest = whole.partition(BEGIN)
        DOCUMENT.write_text("\n".join([before + BEGIN, *table(data), END + rest.partition(END)[2]]), encoding="utf-8")


if __name__ == "__main__":
    main()
