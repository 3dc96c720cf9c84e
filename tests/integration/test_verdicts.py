"""The sentences that a report begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from helpers.run_folder import write_run

from ssad.experiments.runs import kind_of_run, write_report
from ssad.report.load import load_run
from ssad.report.verdict import complete_verdict


def estimate(
    method: str, rate: float, low: float | None, high: float | None, *, events: int = 5, effective: float = 2.0
) -> dict[str, Any]:
    """A line of kind how-often."""
    metrics = {
        "per_million": rate,
        "low": low,
        "high": high,
        "events": events,
        "effective": effective,
        "episodes": 6000,
        "per_hour": rate * 0.45,
    }
    spec = {"scenario": {"name": "lane-traffic/05"}}
    return {
        "key": method,
        "system": "autopilot",
        "group": "lane-traffic",
        "method": method,
        "status": "ok",
        "reason": "",
        "spec": spec,
        "metrics": metrics,
        "n": 6000,
        "seed": 0,
        "suite": "h",
        "versions": {},
        "artefacts": {},
        "case": method,
        "cluster": "lane-traffic/05",
        "wall_s": 1.0,
    }


NONE = estimate("monte-carlo", 0.0, 0.0, 614.6, events=0, effective=0.0)
WEIGHED = estimate("importance", 50.9, 7.85, 192.3, effective=1.9)
BRANCHED = estimate("splitting", 61.8, None, None, events=149, effective=6.5)
ABOUT = "autopilot collides in about"


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            [NONE, BRANCHED, WEIGHED],
            f"{ABOUT} 51 of a million episodes of lane-traffic/05 (95 %: 7.8 to 192; by importance sampling), "
            "22.9 times in 1,000 h. Plain Monte Carlo saw none in 6,000 episodes.",
        ),
        (
            [BRANCHED],
            f"{ABOUT} 62 of a million episodes of lane-traffic/05 (too few repeats for an interval; by splitting), "
            "27.8 times in 1,000 h.",
        ),
        (
            [NONE],
            "autopilot did not collide in 6,000 episodes of lane-traffic/05: fewer than 615 in a million (95 % limit).",
        ),
        (
            [estimate("monte-carlo", 500.0, 100.0, 1400.0, events=3, effective=3.0), WEIGHED],
            f"{ABOUT} 500 of a million episodes of lane-traffic/05 (95 %: 100 to 1,400; by plain Monte Carlo), "
            "225 times in 1,000 h.",
        ),
        (
            [estimate("monte-carlo", 0.0, 0.0, 7.0, events=0), WEIGHED | {"system": "blind"}, WEIGHED, BRANCHED],
            "The methods contradict each other for autopilot in lane-traffic/05: 0 by plain Monte Carlo (95 %: 0 to 7) "
            "and 51 by importance sampling (95 %: 7.8 to 192) collisions in a million episodes. Trust none of them "
            "until more episodes bring them together. "
            "blind collides in about 51 of a million episodes of lane-traffic/05 (95 %: 7.8 to 192; by importance "
            "sampling), 22.9 times in 1,000 h.",
        ),
        (
            [NONE | {"obstacle": "autopilot has no methods snapshot() and restore(states)"}],
            "autopilot did not collide in 6,000 episodes of lane-traffic/05: fewer than 615 in a million (95 % limit). "
            "autopilot is measured by plain Monte Carlo alone: autopilot has no methods snapshot() and "
            "restore(states); with these two methods (ssad.core.driving.Branching), splitting and importance sampling "
            "would measure autopilot too, and find collisions that are too rare to be counted.",
        ),
        (
            [
                NONE | {"obstacle": "autopilot plans over a belief, which no snapshot holds"},
                BRANCHED | {"status": "failed", "reason": "refused", "metrics": {}, "system": "blind"},
            ],
            "autopilot did not collide in 6,000 episodes of lane-traffic/05: fewer than 615 in a million (95 % limit). "
            "autopilot is measured by plain Monte Carlo alone: autopilot plans over a belief, which no snapshot holds.",
        ),
    ],
)
def test_how_rare_collisions_are(lines: list[dict[str, Any]], said: str, tmp_path: Path) -> None:
    suite = {"name": "h", "kind": "how-often", "title": "How often"}
    header = {"suite": suite, "identity": "x", "columns": [], "factors": ["system", "method"]}
    lines = [line | {"key": f"{line['method']} {line['system']}"} for line in lines]
    folder = write_run(tmp_path / "run", header, lines)
    sentences = verdict(load_run(folder))
    assert " ".join(sentences) == said
    page = write_report(folder).read_text()
    places = [page.index(sentence) for sentence in sentences]
    assert places == sorted(places)


def told(folder: Path, kind: str, rows: list[dict[str, Any]], *, planned: int = 0) -> str:
    """The verdict on lines with these fields."""
    lines = [
        {
            "key": str(k),
            "status": "ok",
            "reason": "",
            "n": 1,
            "seed": 0,
            "suite": "s",
            "versions": {},
            "wall_s": 0.0,
            "artefacts": {},
            "spec": {},
            "case": str(k),
            "cluster": str(k),
            **row,
        }
        for k, row in enumerate(rows)
    ]
    header = {"suite": {"name": "s", "kind": kind}, "identity": "x"}
    header |= {"cells": [{"key": str(k)} for k in range(planned)]} if planned else {}
    return " ".join(verdict(load_run(write_run(folder, header, lines))))


def test_searches_of_one_system_share_a_sentence(tmp_path: Path) -> None:
    rows = [
        {"system": "autopilot", "generator": generator, "metrics": {"survived": alive, "CR": hit if alive else None}}
        for generator, alive, hit in (
            ("random", True, False),
            ("random", True, True),
            ("king", True, True),
            ("king", False, None),
        )
    ]
    assert told(tmp_path, "adversarial", rows) == (
        "autopilot is made to collide in scenarios that it survives unchanged: random in 1 of 2, king in 1 of 1."
    )


def test_of_many_generators_the_best_are_named_beside_random_search(tmp_path: Path) -> None:
    hits = {"random": 1, "grid": 0, "king": 4, "cat": 3, "l2c": 2}
    rows = [
        {"system": "autopilot", "generator": name, "metrics": {"survived": True, "CR": k < count}}
        for name, count in hits.items()
        for k in range(4)
    ]
    rows += [{"system": "blind", "generator": "random", "metrics": {"survived": False, "CR": None}}]
    said = told(tmp_path, "adversarial", rows)
    assert "king in 4 of 4, cat in 3 of 4, l2c in 2 of 4, random in 1 of 4 (the best three of 5" in said
    assert "blind survives none of its scenarios unchanged" in said


def digital_line(attack: str | None, score: float, *, norm: str = "linf", radius: float = 5.0) -> dict[str, Any]:
    """A record of kind `digital`, without what only some of its tables need."""
    checks = dict.fromkeys(("loss_before", "loss_after", "gradient_error", "coupling", "used", "change_px"))
    return {
        "detector": "d",
        "attack": attack,
        "loss": None,
        "norm": norm,
        "radius": radius,
        "steps": 10 if attack == "pgd" else 0,
        "options": "",
        "access": "white-box" if attack == "pgd" else "none",
        "replicates": {},
        "metrics": {"mAP": score},
        **checks,
    }


@pytest.mark.parametrize(("noise", "said"), [(0.4, "what lies between is the attack's"), (0.1, "does no more than")])
def test_noise_is_held_against_attacks_that_were_run(tmp_path: Path, noise: float, said: str) -> None:
    scores = {"": 0.5, "noise": noise, "pgd": 0.2}
    rows = [digital_line(name, value) for name, value in scores.items()]
    assert said in told(tmp_path / "all", "digital", rows)
    # noise that nothing survives, two scenes that are easier and a defence do not change what is said of the table
    others = ({"attack": "noise", "row": False}, {"attack": "", "subset": 1}, {"attack": "pgd", "defence": "jpeg"})
    more = [digital_line("", 0.0) | one for one in others]
    assert told(tmp_path / "more", "digital", [*rows, *more]) == told(tmp_path / "all", "digital", rows)
    # before an attack has been run there is nothing to say of noise, and the page says that it is early
    assert told(tmp_path / "some", "digital", rows[:2], planned=3) == "Not finished: 2 of 3 cells have run."


def test_what_harms_the_system_most_is_said_first(tmp_path: Path) -> None:
    rows = [
        {
            "system": "s",
            "perturbation": name,
            "severity": severity,
            "family": name,
            "cluster": f"d{k}",
            "case": f"d{k}",
            "spec": {"repetition": 0},
            "metrics": {"AP": ap, "collision": k < hits},
        }
        for name, severity, ap, hits in (("none", 0, 0.5, 0), ("fog", 5, 0.1, 0), ("blackout", 5, 0.2, 6))
        for k in range(12)
    ]
    said = told(tmp_path, "gap", rows)
    assert said.index("s collided in 0 of 12") < said.index("blackout 5 changes") < said.index("fog 5 changes")


def texture(attack: str, hidden: float | None, **more: Any) -> dict[str, Any]:
    """A line of kind physical."""
    about = {"carrier": "paint", "test": "Oldmarket", "train": "Twinford", "view": "drive", "source": ""}
    metrics = {} if attack == "clean" else {"ASR_25": hidden, "n0_25": 38}
    return {"detector": "d", "attack": attack, "metrics": metrics, "n": 40} | about | more


def test_what_learns_nothing_is_no_attack_however_much_it_hides(tmp_path: Path) -> None:
    rows = [texture("clean", None), texture("noise", 0.4), texture("random", 0.1), texture("das", 0.2)]
    assert told(tmp_path / "paint", "physical", rows) == (
        "das hides 20% of the 38 targets that d finds clean. The strongest control (noise) hides 40%."
    )
    lights = [texture(name, share, carrier="light, night") for name, share in (("random laser", 0.4), ("laser", 0.2))]
    assert told(tmp_path / "light", "physical", lights) == (
        "laser hides 20% of the 38 targets that d finds clean. The strongest control (random laser) hides 40%."
    )
    assert told(tmp_path / "only", "physical", rows[:3]) == "See the table."


def test_what_is_rarely_found_clean_has_no_success_rate(tmp_path: Path) -> None:
    rows = [texture("clean", None), texture("das", None), texture("grey", None)]
    for row in rows[1:]:
        row["metrics"]["n0_25"] = 3
    assert told(tmp_path / "few", "physical", rows) == (
        "d finds 3 of 40 clean targets with a score above 0.25, less than 90%: attacks on it have no success rate."
    )
    uncounted = [texture("das", 0.9) | {"metrics": {"ASR_25": 0.9}}]
    assert told(tmp_path / "old", "physical", uncounted) == "See the table.", "without n0 a rate says nothing"


def test_an_attack_is_held_against_controls_of_its_own_pictures(tmp_path: Path) -> None:
    rows = [
        texture("das", 0.9),
        texture("grey", 0.0),
        texture("das", 0.6, test="Larkhill"),
        texture("grey", 0.5, test="Larkhill"),
        texture("grey", 0.7, view="grid"),
        texture("grey", 0.3, carrier="patch"),
    ]
    assert told(tmp_path, "physical", rows) == (
        "das hides 90% of the 38 targets that d finds clean in Oldmarket. The strongest control (grey) hides 0%."
    )


def test_of_rows_of_one_attack_the_strongest_counts_beside_noise_of_its_size(tmp_path: Path) -> None:
    rows = [
        digital_line(attack, score, norm=norm, radius=radius)
        for attack, norm, radius, score in (
            (None, None, 0.0, 0.5),
            ("noise", "linf", 5.0, 0.45),
            ("noise", "l2", 900.0, 0.2),
            ("pgd", "linf", 5.0, 0.3),
            ("pgd", "l2", 900.0, 0.4),
        )
    ]
    said = told(tmp_path / "many", "digital", rows)
    assert "costs most is pgd, which leaves 30%" in said
    assert "leaves d an mAP of 45%: what lies between is the attack's" in said
    harmless = told(tmp_path / "none", "digital", [rows[0], rows[3] | {"metrics": {"mAP": 0.6}}])
    assert harmless == "d: mAP 50% clean; no attack takes any of it."


def test_what_failed_is_named_and_in_no_share(tmp_path: Path) -> None:
    failed = {"status": "failed", "reason": "hung", "metrics": {}}
    drives = [{"system": "s", "metrics": {"collision": True, "route_completion": 0.5}}, {"system": "s"} | failed]
    said = told(tmp_path / "drives", "driving", drives)
    assert said == (
        "s collided in 1 of 1 drives; 1 more failed, so its collision rate lies in 0.00–1.00 whatever they were, "
        "and completed 50% of its routes."
    )
    assert told(tmp_path / "none", "driving", drives[1:]) == "s has no collision rate: all of its 1 drives failed."
    alive = {"system": "s", "generator": "king", "metrics": {"survived": True, "CR": False}}
    said = told(tmp_path / "searches", "adversarial", [alive, alive, {"system": "s", "generator": "king"} | failed])
    assert (
        said == "No generator makes s collide in scenarios that it survives unchanged: king in 0 of 2 (1 more failed)."
    )
    assert told(tmp_path / "dead", "adversarial", [{"system": "s", "generator": "king"} | failed]) == "See the table."


def verdict(run):
    return complete_verdict(run, kind_of_run(run).verdict(run))
