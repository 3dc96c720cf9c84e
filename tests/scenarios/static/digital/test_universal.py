"""One change for many pictures."""

from __future__ import annotations

import pytest
import torch

from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital import Budget, make_attack, px, run_attack
from ssad.scenarios.static.digital.objectives import Fabricate, Vanish
from ssad.scenarios.static.digital.universal import Universal, fit_universal
from ssad.scenarios.static.digital.victim import Victim

from .toy_detector import ToyDetector, toy_scene

BUDGETS = [Budget(px(5)), Budget(px(250), "l2")]


@pytest.mark.parametrize("method", ["sign", "adam"])
@pytest.mark.parametrize("budget", BUDGETS, ids=str)
def test_it_raises_the_loss_of_pictures_that_it_was_not_fitted_to(budget: Budget, method: str) -> None:
    detector = ToyDetector()
    images, truth = toy_scene(4)
    change = fit_universal(
        [Victim(detector, images, truth, Fabricate())],
        budget,
        epochs=10,
        method=method,  # type: ignore[arg-type]
    )
    size = change.abs().max() if budget.norm == "linf" else change.norm()
    assert 0.9 * budget.radius < float(size) <= budget.radius * (1 + 1e-6)
    fresh, fresh_truth = toy_scene(4, seed=1)
    attack = Universal(change)
    found = run_attack(attack, detector, fresh, fresh_truth, budget, objective=Fabricate())
    noise = run_attack(make_attack("noise"), detector, fresh, fresh_truth, budget, objective=Fabricate())
    own = run_attack(make_attack("pgd"), detector, fresh, fresh_truth, budget, objective=Fabricate())
    gain, most = (found.after - found.before).mean(), (own.after - own.before).mean()
    assert float(gain) > 4 * float((noise.after - noise.before).mean().abs())
    assert float(gain) > 0.5 * float(most)
    assert (found.cost.queries, found.cost.gradients) == (0, 0)
    moved = ((found.images - fresh).double() * 255).round().flatten(1)
    longest = moved.abs().max() if budget.norm == "linf" else moved.norm(dim=1).max()
    assert float(longest) <= budget.radius * 255 + 1e-9


def test_it_does_not_depend_on_the_batches_and_may_be_read_anew() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(4)
    one = fit_universal([Victim(detector, images, truth, Vanish())], BUDGETS[0], epochs=4)
    parts = [Victim(detector, images[a:b], truth[a:b], Vanish()) for a, b in ((0, 1), (1, 4))]
    assert torch.equal(fit_universal(iter(parts), BUDGETS[0], epochs=4), one)
    read = []

    def anew() -> list[Victim]:
        read.append(1)
        return parts

    assert torch.equal(fit_universal(anew, BUDGETS[0], epochs=4), one)
    assert len(read) >= 5


def test_a_smaller_budget_holds_a_larger_change() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(2)
    change = torch.zeros(1, 3, 48, 64)
    change[..., 8:16, 8:16] = 0.5
    attack = Universal(change)
    for budget in (Budget(px(2)), Budget(px(40), "l2")):
        found = run_attack(attack, detector, images, truth, budget, objective="full")
        moved = ((found.images - images).double() * 255).round().flatten(1)
        longest = moved.abs().max() if budget.norm == "linf" else moved.norm(dim=1).max()
        assert 0.8 * budget.radius * 255 < float(longest) <= budget.radius * 255 + 1e-9
        inside = attack.perturb(Victim(detector, images, truth, Vanish()), budget) - images
        size = inside.abs().max() if budget.norm == "linf" else inside.flatten(1).norm(dim=1).max()
        assert float(size) <= budget.radius * (1 + 1e-5)


def test_the_detector_is_as_it_was() -> None:
    detector = ToyDetector()
    images, truth = toy_scene(1)
    victim = Victim(detector, images, truth, Vanish())
    detector.train()
    fit_universal([victim], BUDGETS[0], epochs=1)
    assert detector.training


def test_bad_input_is_named() -> None:
    detector, (images, truth) = ToyDetector(), toy_scene(1)
    victim = Victim(detector, images, truth, Vanish())
    with pytest.raises(ConfigError, match="there are no pictures"):
        fit_universal([], BUDGETS[0])
    with pytest.raises(ConfigError, match="epochs must be 1 or more"):
        fit_universal([victim], BUDGETS[0], epochs=0)
    other = Victim(detector, *toy_scene(1, size=(32, 32)), Vanish())
    with pytest.raises(ConfigError, match="all pictures must have one size"):
        fit_universal([victim, other], BUDGETS[0])
    with pytest.raises(ConfigError, match=r"shape \[1, 3, H, W\]"):
        Universal(torch.zeros(3, 8, 8))
    with pytest.raises(ConfigError, match="a change of 8 x 8 for pictures of 48 x 64"):
        run_attack(Universal(torch.zeros(1, 3, 8, 8)), detector, images, truth, BUDGETS[0], objective="full")
