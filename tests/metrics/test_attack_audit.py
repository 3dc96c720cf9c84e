"""The audit of attacks: sound ones pass, weakened ones are named, and so is the paper's own row."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad.experiments.perception.digital.page import published_attempts
from ssad.metrics.attack_audit import RULES, Attempt, ReferenceComparison, Verdict, audit, weaker

CLEAN = 0.3
BASE = Attempt(
    "eye",
    "pgd",
    0.02,
    CLEAN,
    "full",
    "linf",
    5.0,
    10,
    "white-box",
    "",
    (),
    before=1.0,
    after=9.0,
    gradient_error=1e-3,
    coupling=1e-7,
    used=0.7,
    change=5.0,
)
NOISE = replace(BASE, attack="noise", score=0.29, steps=0, access="none", used=1.0, gradient_error=None, coupling=None)
FGSM = replace(BASE, attack="fgsm", score=0.06, steps=1, used=1.0)
EQUAL = ReferenceComparison("pgd", 1.0, 9.0, 0.1, {"apgd": (8.5, 0.12), "pgd": (9.1, 0.1), "square": (1.5, 0.3)})
SOUND = [
    NOISE,
    FGSM,
    BASE,
    replace(BASE, radius=2.0, score=0.1, change=2.0),
    replace(BASE, steps=20, score=0.01),
    replace(BASE, options="restarts=2", score=0.018),
    replace(BASE, radius=255.0, score=0.0, change=255.0, used=0.3),
    replace(BASE, attack="square", access="black-box", score=0.1, steps=0, gradient_error=None),
    replace(BASE, attack="cw", loss="margin", score=0.0),
    replace(BASE, loss="depth", score=0.2),
    replace(BASE, options="draws=2", comparisons=(EQUAL,) * 20),
    replace(BASE, source="other", score=0.25, gradient_error=None),
]


def rules(verdict: Verdict) -> list[str]:
    return [fault.rule for fault in verdict.faults]


def with_changed(**changes: Any) -> list[Attempt]:
    """The sound attempts, PGD with ten steps at 5 px changed."""
    return [replace(one, **changes) if one is BASE else one for one in SOUND]


def test_sound_attacks_pass_and_every_rule_was_looked_at() -> None:
    verdict = audit(SOUND)
    assert verdict.faults == ()
    assert verdict.passed
    assert all(verdict.compared[name] for name in RULES), verdict.compared
    assert verdict.text == f"Audit passed: {sum(verdict.compared.values())} comparisons, no fault."


WEAKENED: dict[str, tuple[dict[str, Any], str, str]] = {
    "a step that is too small": ({"used": 0.05, "score": 0.2}, "used", "uses 5% of its budget"),
    "a loss on suppressed boxes": ({"radius": 255.0, "score": 0.1, "change": 255.0}, "unbounded", "must leave nothing"),
    "a gradient that is detached": ({"gradient_error": 0.9}, "gradient", "differs from finite differences by 90%"),
    "a sign error": ({"after": 0.5, "score": 0.31}, "loss", "fell from 1 to 0.5: a wrong sign"),
    "a loss that is coupled by the batch": ({"coupling": 0.4}, "coupling", "changes by 40% with what else is in"),
    "a budget before rounding": ({"change": 6.0}, "budget", "6 px from the clean one"),
}


def test_an_attack_below_the_reference_ensemble_is_named() -> None:
    short = tuple(replace(EQUAL, loss=loss) for loss in np.linspace(5.0, 6.0, 20))
    sound = [one for one in SOUND if not one.comparisons]
    verdict = audit([*sound, replace(BASE, options="draws=2", comparisons=short)])
    assert rules(verdict) == ["reference"]
    assert "pgd with as many gradients by 8.1: it falls short by 44% [" in verdict.faults[0].text
    few = audit([*sound, replace(BASE, options="draws=2", comparisons=short[:7])])
    assert few.compared["reference"] == 0, "seven images give no interval"
    ensemble = replace(BASE, attack="ensemble", comparisons=(*short, *(replace(EQUAL, attack="apgd"),) * 8))
    texts = [fault.text for fault in audit([*sound, ensemble]).faults if fault.rule == "reference"]
    assert len(texts) == 1
    assert ", member pgd raises its loss" in texts[0]


@pytest.mark.parametrize("case", WEAKENED.values(), ids=WEAKENED.keys())
def test_six_weakened_attacks_are_named(case: tuple[dict[str, Any], str, str]) -> None:
    changes, rule, words = case
    verdict = audit(with_changed(**changes))
    assert not verdict.passed
    assert rule in rules(verdict)
    (text,) = [fault.text for fault in verdict.faults if fault.rule == rule]
    assert words in text
    assert "pgd on loss full with 10 steps" in text
    assert verdict.text.startswith("Audit: ")


ORDER: dict[str, tuple[list[Attempt], str, str]] = {
    "more steps": ([BASE, replace(BASE, steps=20, score=0.1)], "steps", "with 20 steps at 5 px leaves 10.00 mAP"),
    "a larger budget": ([BASE, replace(BASE, radius=8.0, score=0.1)], "radius", "at 8 px leaves 10.00 mAP"),
    "ten steps and one": ([FGSM, replace(BASE, score=0.1)], "iterated", "weaker than a single step is mis-tuned"),
    "many steps and one on another loss": (
        [FGSM, replace(BASE, attack="cw", loss="margin", steps=5, score=0.1)],
        "losses",
        "even on another loss",
    ),
    "a black-box attack": (
        [BASE, replace(BASE, attack="square", access="black-box", score=0.0, loss="margin")],
        "access",
        "masked",
    ),
    "transfer": ([replace(BASE, score=0.1), replace(BASE, source="other")], "transfer", "against other"),
    "restarts that lose": ([BASE, replace(BASE, options="restarts=3", score=0.1)], "restarts", "start is not kept"),
    "restarts that gain": (
        [replace(BASE, score=0.1), replace(BASE, options="restarts=3", score=0.02)],
        "restarts",
        "restarts gain much",
    ),
    "noise": ([NOISE, replace(BASE, score=0.29)], "noise", "random noise of the same size 29.00 mAP"),
    "a flat loss": ([replace(BASE, after=1.0)], "loss", "did not move"),
}


@pytest.mark.parametrize("case", ORDER.values(), ids=ORDER.keys())
def test_attacks_in_the_wrong_order_are_named(case: tuple[list[Attempt], str, str]) -> None:
    attempts, rule, words = case
    verdict = audit([replace(one, change=None, used=None) for one in attempts])
    assert rules(verdict) == [rule]
    assert words in verdict.faults[0].text


def test_detectors_losses_norms_and_sizes_are_not_mixed() -> None:
    worse = replace(BASE, score=0.1)
    for changed in (
        {"detector": "other"},
        {"loss": "margin"},
        {"norm": "l2", "change": 1.0},
        {"radius": 3.0, "change": 3.0},
    ):
        assert audit([FGSM, replace(worse, **changed)]).compared["iterated"] == 0
    assert audit([BASE, replace(worse, attack="apgd")]).faults == ()


def test_what_may_be_weaker_than_a_single_step_on_another_loss() -> None:
    worse = replace(BASE, attack="cw", loss="margin", score=0.1)
    assert [fault.rule for fault in audit([FGSM, worse]).faults] == ["losses"]
    paired = {"draws": (0.02, 0.14, 0.05, 0.2)}
    noisy = replace(worse, draws=(0.2, 0.02, 0.15, 0.03))
    for sound in (
        replace(worse, loss="depth"),
        replace(worse, steps=2),
        replace(worse, radius=2.0, change=2.0),
        replace(worse, norm="l2", change=1.0),
        replace(worse, score=0.065),
        replace(worse, source="other"),
        noisy,
    ):
        assert audit([replace(FGSM, **paired), sound]).faults == ()


def test_an_attack_is_judged_beside_another_loss_by_its_most_steps() -> None:
    slow, done = replace(BASE, loss="margin", steps=5, score=0.1), replace(BASE, loss="margin", score=0.02)
    assert rules(audit([FGSM, slow])) == ["losses"]
    assert audit([FGSM, slow, done]).faults == ()
    assert rules(audit([FGSM, slow, replace(done, score=0.1)])) == ["losses"]
    assert rules(audit([FGSM, slow, replace(done, attack="apgd")])) == ["losses"], "another attack answers for itself"


def test_a_budget_may_be_too_small_for_an_attack_and_for_noise() -> None:
    small = replace(BASE, radius=1.0, change=1.0, score=CLEAN)
    noise = replace(NOISE, radius=1.0, change=1.0, score=CLEAN)
    assert audit([NOISE, BASE, noise, small]).passed
    assert rules(audit([noise, small])) == ["noise"], "at its largest budget it must do something"
    assert rules(audit([NOISE, BASE, replace(noise, score=0.2), small])) == ["noise"]


def test_what_differs_by_noise_alone_is_no_fault() -> None:
    draws = tuple(0.02 + 0.01 * k for k in range(-2, 3))
    one, other = replace(BASE, score=0.05, draws=draws[::-1]), replace(FGSM, score=0.02, draws=draws)
    assert not weaker(one, other), "two standard errors of the paired difference are 0.063"
    assert weaker(replace(one, draws=draws), other), "paired draws that move together tell"
    assert weaker(replace(one, draws=()), other)
    assert not weaker(replace(one, score=0.02 + 0.019 * CLEAN, draws=()), other), (
        "less than a fiftieth of the clean score"
    )


def test_an_attack_that_has_done_its_work_need_not_use_its_budget() -> None:
    assert audit([replace(BASE, used=0.01, score=0.0)]).passed


def test_a_run_in_which_nothing_can_be_compared_does_not_pass() -> None:
    verdict = audit([])
    assert not verdict.passed
    assert verdict.text.startswith("Audit: nothing to look at. Not in this run: more steps")


def test_the_papers_own_row_is_flagged_and_its_others_are_not() -> None:
    (fault,) = audit(published_attempts()).faults
    assert (fault.rule, fault.detector) == ("iterated", "PGD (paper)")
    assert "PGD with 10 steps at 5 px leaves 19.61 mAP, FGSM with 1 step at 5 px 8.77 mAP" in fault.text


@pytest.mark.parametrize(
    ("changed", "pairs"),
    [
        ({}, 1),
        ({"options": "draws=2"}, 1),
        ({"options": "restarts=2"}, 0),
        ({"attack": "mifgsm"}, 0),
        ({"loss": "margin"}, 0),
        ({"norm": "l2", "change": 1.0}, 0),
        ({"radius": 3.0, "change": 3.0}, 0),
        ({"steps": 20}, 0),
    ],
)
def test_transferred_attacks_are_compared_with_the_same_attack_alone(changed: dict[str, Any], pairs: int) -> None:
    transferred = replace(BASE, source="other", score=0.25, gradient_error=None)
    assert audit([replace(BASE, **changed), transferred]).compared["transfer"] == pairs


def test_two_standard_errors_are_of_the_differences_around_their_mean() -> None:
    first, second = replace(BASE, draws=(0.11, 0.12, 0.08, 0.09)), replace(BASE, draws=(0.05, 0.06, 0.06, 0.07))
    differences = (0.06, 0.06, 0.02, 0.02)  # of mean 0.04
    margin = 2.0 * math.sqrt(sum((difference - 0.04) ** 2 for difference in differences) / 3)
    assert margin > 0.02 * CLEAN
    assert weaker(replace(first, score=0.1), replace(second, score=0.1 - 1.01 * margin))
    assert not weaker(replace(first, score=0.1), replace(second, score=0.1 - 0.99 * margin))


@pytest.mark.parametrize(("score", "named"), [(3.0, False), (3.01, True)])
def test_restarts_may_gain_a_twentieth_of_the_clean_score(score: float, named: bool) -> None:
    few = replace(BASE, clean=20.0, score=score, change=None, used=None)
    verdict = audit([few, replace(few, options="restarts=3", score=2.0)])
    assert ("restarts" in rules(verdict)) == named


def test_a_picture_may_be_as_far_from_the_clean_one_as_the_budget() -> None:
    assert "budget" not in rules(audit([replace(BASE, change=BASE.radius)]))
    assert "budget" in rules(audit([replace(BASE, change=BASE.radius * 1.001)]))
