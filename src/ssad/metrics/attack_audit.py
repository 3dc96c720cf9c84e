"""Audit of attacks: checks the records of a run for signs that an attack was weaker than it could be.

A badly tuned attack, a wrong gradient or a broken budget leaves traces in the results: the attack gets weaker with
more steps, it is weaker than a single step, or no stronger than noise. Source of most rules: Carlini et al., On
Evaluating Adversarial Robustness (2019), section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from ssad.metrics.intervals import Clusters, mean_limits

NOISE = 0.02  # share of the clean score within which two attacks count as equal
LEFT = 0.05  # share of the clean score under which the detector counts as defeated
RESTARTS = 0.05  # share of the clean score that restarts may gain without a finding
GRADIENT = 0.25  # relative error of a gradient; that of losses with a detached target is up to a fifth
COUPLED = 0.01  # relative change of an image's loss by another image of the batch
MIN_BUDGET_SHARE = 0.25  # minimum share of the budget that an attack uses, unless the detector is defeated
MIN_STEPS = 5  # steps from which an attack is expected to beat a single step on any loss
WHOLE_LOSSES = frozenset({"full", "classification", "vanish", "margin"})  # losses about all that a detector finds
MIN_PAIRS = 8  # images from which a comparison with the reference ensemble has an interval
LOSS_SHORTFALL = 0.1  # share of the reference's rise of the loss that a sound attack may lack
QUALITY_SHORTFALL = 0.02  # average precision of an image that it may leave beyond what the reference leaves
UNBOUNDED = 64.0  # code values from which an L-infinity budget hides any picture


@dataclass(frozen=True, slots=True)
class ReferenceComparison:
    """Effect of an attack and of the reference ensemble on one image (equal loss, budget and number of gradients).

    Attributes:
        attack: Name of the attack, or of the member of an ensemble.
        loss_before: Ascended loss of the clean image.
        loss: Ascended loss under the attack.
        quality: Mean average precision of the image under the attack, 0 to 1.
        references: Loss and quality under each member of the reference ensemble, by its name.
    """

    attack: str
    loss_before: float
    loss: float
    quality: float
    references: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attack on one detector, as recorded; values missing from the record are None.

    Attributes:
        detector: Name.
        attack: Name; "noise" for random noise of the size of the budget.
        score: Score of the attacked detector (mAP).
        clean: Score of the detector without attack.
        loss: The ascended loss; "" if unknown.
        norm: Norm of the budget.
        radius: Radius of the budget, 8-bit code values.
        steps: Gradient steps of one start.
        access: "white-box", "black-box", "none".
        options: Further settings, as text; `restarts` is read from it.
        draws: Bootstrap replicates of the score, paired between attempts.
        before: Mean of the ascended loss before the attack.
        after: Mean of the ascended loss after the attack.
        gradient_error: See `ssad.scenarios.static.digital.scene_attacker`, as for the next three.
        coupling: Relative change of an image's loss by the rest of its batch.
        used: Share of the budget that is used.
        change: Largest distance of a stored image from the clean one.
        source: Detector that the images were made against, if another one is evaluated.
        group: Further condition that must be equal for scores to be compared, such as a defence or a target; part
            of the detector's name in findings.
        comparisons: Comparisons with the reference ensemble, one for each image that was chosen for it.
    """

    detector: str
    attack: str
    score: float
    clean: float
    loss: str = ""
    norm: str = "linf"
    radius: float = 5.0
    steps: int = 1
    access: str = "white-box"
    options: str = ""
    draws: tuple[float, ...] = ()
    before: float | None = None
    after: float | None = None
    gradient_error: float | None = None
    coupling: float | None = None
    used: float | None = None
    change: float | None = None
    source: str = ""
    group: str = ""
    comparisons: tuple[ReferenceComparison, ...] = ()

    @property
    def restarts(self) -> int:
        """Random starts after the first."""
        settings = dict(setting.split("=", 1) for setting in self.options.split() if "=" in setting)
        return int(settings.get("restarts", "0"))

    @property
    def title(self) -> str:
        """Description of the attempt in a sentence."""
        parts = [self.attack, f"on loss {self.loss}" if self.loss and self.attack != "noise" else ""]
        parts.append("" if self.attack == "noise" else f"with {self.steps} step{'s' if self.steps != 1 else ''}")
        parts.append(f"at {self.radius:g} px" + (" (L2)" if self.norm == "l2" else ""))
        parts.append(f"({self.options})" if self.options else "")
        parts.append(f"against {self.source}" if self.source else "")
        return " ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True)
class AuditFault:
    """An objection against an attack: the violated rule, the detector, a sentence."""

    rule: str
    detector: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of an audit.

    Attributes:
        compared: Rule -> number of comparisons; 0 if the run lacks what the rule needs.
        faults: All faults.
    """

    compared: Mapping[str, int]
    faults: tuple[AuditFault, ...]

    @property
    def passed(self) -> bool:
        """True if there is no fault, and at least one comparison."""
        return not self.faults and any(self.compared.values())

    @property
    def text(self) -> str:
        """The verdict in a sentence or two."""
        skipped_rules = [RULES[rule][0] for rule, count in self.compared.items() if not count]
        skipped_text = f" Not in this run: {'; '.join(skipped_rules)}." if skipped_rules else ""
        if not any(self.compared.values()):
            return f"Audit: nothing to look at.{skipped_text}"
        if self.passed:
            return f"Audit passed: {sum(self.compared.values())} comparisons, no fault.{skipped_text}"
        count = len(self.faults)
        return (
            f"Audit: {count} fault{'s' if count > 1 else ''} in {sum(self.compared.values())} "
            f"comparisons.{skipped_text}"
        )


Finding = str | None  # a sentence, or None where a comparison found no fault
Rule = Callable[[Sequence[Attempt]], Iterator[Finding]]


def audit(attempts: Iterable[Attempt]) -> Verdict:
    """Apply all rules to the attempts of each detector.

    Args:
        attempts: Attempts of one run; rules that need absent ones (noise, black-box attacks, restarts) are
            skipped.

    Returns:
        Verdict, with faults in the order of the rules.
    """
    by_detector: dict[str, list[Attempt]] = {}
    for attempt in attempts:
        by_detector.setdefault(", ".join(filter(None, [attempt.detector, attempt.group])), []).append(attempt)
    compared, faults = dict.fromkeys(RULES, 0), []
    for rule_name, (_, rule) in RULES.items():
        for detector, detector_attempts in by_detector.items():
            for finding in rule(detector_attempts):
                compared[rule_name] += 1
                if finding is not None:
                    faults.append(AuditFault(rule_name, detector, finding))
    return Verdict(compared, tuple(faults))


def weaker(attempt: Attempt, other_attempt: Attempt) -> bool:
    """Return whether an attempt leaves a higher score than another, beyond noise.

    The margin for noise is a share (`NOISE`) of the clean score or two standard errors of the paired difference,
    whichever is larger.

    Args:
        attempt: The attempt that may be the weaker attack.
        other_attempt: The attempt to compare it with.

    Returns:
        True if `attempt` is the weaker attack.
    """
    margin = NOISE * max(attempt.clean, 0.0)
    if len(attempt.draws) == len(other_attempt.draws) > 1:
        score_pairs = zip(attempt.draws, other_attempt.draws, strict=True)
        differences = [first_score - second_score for first_score, second_score in score_pairs]
        mean = math.fsum(differences) / len(differences)
        variance = math.fsum((difference - mean) ** 2 for difference in differences) / (len(differences) - 1)
        margin = max(margin, 2.0 * math.sqrt(variance))
    return attempt.score > other_attempt.score + margin


def _pair(stronger: Attempt, weaker_attempt: Attempt, reason: str) -> Finding:
    """Return a sentence if `stronger`, which should be the stronger attack, is weaker."""
    if not weaker(stronger, weaker_attempt):
        return None
    return (
        f"{stronger.title} leaves {_percent(stronger.score)}, "
        f"{weaker_attempt.title} {_percent(weaker_attempt.score)}: {reason}"
    )


def _percent(score: float) -> str:
    return f"{100 * score:.2f} mAP"


def _direct_attempts(attempts: Sequence[Attempt]) -> list[Attempt]:
    """Return the attacks that were made against the evaluated detector, without noise."""
    return [attempt for attempt in attempts if attempt.attack != "noise" and not attempt.source]


def _along(attempts: Sequence[Attempt], field: str) -> Iterator[tuple[Attempt, Attempt]]:
    """Neighbours, smaller and larger, that differ in one attribute only."""
    names = [
        setting_name
        for setting_name in ("attack", "loss", "norm", "radius", "steps", "options")
        if setting_name != field
    ]
    groups: dict[tuple[object, ...], list[Attempt]] = {}
    for attempt in _direct_attempts(attempts):
        groups.setdefault(tuple(getattr(attempt, key_name) for key_name in names), []).append(attempt)
    for group in groups.values():
        ordered = sorted(group, key=lambda attempt: float(getattr(attempt, field)))
        yield from (
            (smaller, larger)
            for smaller, larger in pairwise(ordered)
            if getattr(smaller, field) < getattr(larger, field)
        )


def _method(attempt: Attempt) -> tuple[object, ...]:
    """An attack but for its steps."""
    return attempt.attack, attempt.loss, attempt.norm, attempt.radius, attempt.options


def _steps(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for shorter, longer in _along(attempts, "steps"):
        yield _pair(longer, shorter, "more steps made it weaker, so its steps are mis-tuned")


def _radius(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for smaller, larger in _along(attempts, "radius"):
        yield _pair(larger, smaller, "a larger budget made it weaker, so it does not use its budget")


def _iterated(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    white_box = [attempt for attempt in _direct_attempts(attempts) if attempt.access == "white-box"]
    for single_step in white_box:
        for iterated in white_box:
            is_comparable = (single_step.loss, single_step.norm, single_step.radius) == (
                iterated.loss,
                iterated.norm,
                iterated.radius,
            )
            if (
                is_comparable
                and single_step.steps == 1
                and iterated.steps > 1
                and single_step.attack != iterated.attack
            ):
                yield _pair(iterated, single_step, "an iterated attack weaker than a single step is mis-tuned")


def _losses(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    """Compare iterated attacks with single steps on other losses.

    A loss about one aspect only, such as depth, may do less than a single step on the whole training loss. Losses
    need more or fewer steps to take effect, so each attack is judged by its largest number of steps: the start of
    a curve over steps says nothing about its end.
    """
    white_box = [attempt for attempt in _direct_attempts(attempts) if attempt.access == "white-box"]
    longest_attempts = [
        attempt
        for attempt in white_box
        if not any(attempt.steps < longer.steps and _method(attempt) == _method(longer) for longer in white_box)
    ]
    for single_step in white_box:
        for iterated in longest_attempts:
            is_comparable = (single_step.norm, single_step.radius) == (
                iterated.norm,
                iterated.radius,
            ) and single_step.loss != iterated.loss
            if (
                is_comparable
                and single_step.steps == 1
                and iterated.steps >= MIN_STEPS
                and iterated.loss in WHOLE_LOSSES
            ):
                yield _pair(iterated, single_step, "many steps weaker than one, even on another loss, are mis-tuned")


def _access(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for _, group in _sizes(attempts):
        attempts_by_access = [
            [attempt for attempt in group if attempt.access == access] for access in ("white-box", "black-box")
        ]
        if all(attempts_by_access):
            white, black = (min(candidates, key=lambda attempt: attempt.score) for candidates in attempts_by_access)
            yield _pair(white, black, "a black-box attack beats the best white-box one, so the gradient is masked")


def _transfer(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    def method(attempt: Attempt) -> tuple[object, ...]:
        settings = [setting for setting in attempt.options.split() if not setting.startswith("draws=")]
        return attempt.attack, attempt.loss, attempt.norm, attempt.radius, attempt.steps, settings

    for transferred in (attempt for attempt in attempts if attempt.source):
        for direct_attempt in _direct_attempts(attempts):
            if method(direct_attempt) == method(transferred):
                yield _pair(
                    direct_attempt,
                    transferred,
                    "what was made against something else hurts more, so the gradient is masked",
                )


def _restarts(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for first, second in combinations(_direct_attempts(attempts), 2):
        fewer_restarts, more_restarts = sorted((first, second), key=lambda attempt: attempt.restarts)
        is_comparable = all(
            getattr(fewer_restarts, name) == getattr(more_restarts, name)
            for name in ("attack", "loss", "norm", "radius", "steps")
        )
        if not is_comparable or fewer_restarts.restarts == more_restarts.restarts:
            continue
        finding = _pair(more_restarts, fewer_restarts, "restarts made it weaker, so the best start is not kept")
        if (
            finding is None
            and fewer_restarts.score - more_restarts.score > RESTARTS * fewer_restarts.clean
            and weaker(fewer_restarts, more_restarts)
        ):
            finding = (
                f"{fewer_restarts.title} leaves {_percent(fewer_restarts.score)}, {more_restarts.title} "
                f"{_percent(more_restarts.score)}: restarts gain much, "
                "so one start ends far from the best"
            )
        yield finding


def _above_noise(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    """Find attacks that do no better than random noise of the same size.

    A small budget may be too small to change anything, so an attack must beat noise only at its largest budget;
    at no budget may noise beat the attack.
    """
    pairs = [
        (noise, attempt)
        for noise, group in _sizes(attempts)
        for attempt in group
        if noise is not None and noise.score > LEFT * noise.clean
    ]
    largest_drop: dict[tuple[object, ...], float] = {}
    for _, attempt in pairs:
        settings = attempt.attack, attempt.loss, attempt.norm, attempt.steps, attempt.options
        largest_drop[settings] = max(attempt.radius, largest_drop.get(settings, 0.0))
    for noise, attempt in pairs:
        is_largest = (
            attempt.radius == largest_drop[attempt.attack, attempt.loss, attempt.norm, attempt.steps, attempt.options]
        )
        is_beaten = weaker(attempt, noise) or (is_largest and attempt.score >= noise.score)
        yield (
            None
            if not is_beaten
            else (
                f"{attempt.title} leaves {_percent(attempt.score)}, random noise of the same "
                f"size {_percent(noise.score)}: "
                "it attacks nothing"
            )
        )


def _sizes(attempts: Sequence[Attempt]) -> Iterator[tuple[Attempt | None, list[Attempt]]]:
    """Yield the noise, if any, and the attacks for each budget."""
    groups: dict[tuple[str, float], list[Attempt]] = {}
    for attempt in attempts:
        groups.setdefault((attempt.norm, attempt.radius), []).append(attempt)
    for group in groups.values():
        yield next((attempt for attempt in group if attempt.attack == "noise"), None), _direct_attempts(group)


def _unbounded(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in _direct_attempts(attempts):
        if attempt.norm == "linf" and attempt.radius >= UNBOUNDED and attempt.steps > 1:
            yield (
                None
                if attempt.score <= LEFT * attempt.clean
                else (
                    f"{attempt.title} leaves {_percent(attempt.score)} of "
                    f"{_percent(attempt.clean)}: a budget that hides the "
                    "picture must leave nothing, so the loss stops before the detections do"
                )
            )


def _rises(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in _direct_attempts(attempts):
        if attempt.before is not None and attempt.after is not None:
            loss_rise = attempt.after - attempt.before
            if loss_rise > 0 or (loss_rise == 0 and attempt.score <= LEFT * attempt.clean):
                yield None
            elif loss_rise < 0:
                yield (
                    f"{attempt.title}: the loss it ascends fell from {attempt.before:.4g} to "
                    f"{attempt.after:.4g}: a wrong sign"
                )
            else:
                yield (
                    f"{attempt.title}: the loss it ascends did not move from {attempt.before:.4g}: "
                    f"the gradient is cut off"
                )


def _gradient(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in _direct_attempts(attempts):
        if attempt.gradient_error is not None:
            yield (
                None
                if attempt.gradient_error <= GRADIENT
                else (
                    f"{attempt.title}: its gradient differs from finite differences by "
                    f"{attempt.gradient_error:.0%}: it is "
                    "detached, or masked"
                )
            )


def _coupling(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in _direct_attempts(attempts):
        if attempt.coupling is not None:
            yield (
                None
                if attempt.coupling <= COUPLED
                else (
                    f"{attempt.title}: an image's loss changes by {attempt.coupling:.0%} with "
                    "what else is in its batch: "
                    "images are not attacked each by itself"
                )
            )


def _budget(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in attempts:
        if attempt.change is not None:
            yield (
                None
                if attempt.change <= attempt.radius * (1 + 1e-5) + 1e-6
                else (
                    f"{attempt.title}: a stored picture is {attempt.change:g} px from the clean "
                    "one: the budget does not hold "
                    "after rounding"
                )
            )


def _used(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for attempt in _direct_attempts(attempts):
        if attempt.used is not None and attempt.score > LEFT * attempt.clean:
            yield (
                None
                if attempt.used >= MIN_BUDGET_SHARE
                else (
                    f"{attempt.title} uses {attempt.used:.0%} of its budget and leaves "
                    f"{_percent(attempt.score)}: its steps are "
                    "too small"
                )
            )


def _reference(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    """Compare each attack with the strongest member of the reference ensemble, image by image.

    The images are the sample, so the interval is of the attack's shortfall on such images of this run.
    """
    for attempt in _direct_attempts(attempts):
        by_attack: dict[str, list[ReferenceComparison]] = {}
        for comparison in attempt.comparisons:
            by_attack.setdefault(comparison.attack, []).append(comparison)
        for attack, comparisons in by_attack.items():
            if len(comparisons) >= MIN_PAIRS:
                title = attempt.title if len(by_attack) == 1 else f"{attempt.title}, member {attack}"
                yield reference_finding(comparisons, title)


def reference_finding(comparisons: Sequence[ReferenceComparison], title: str) -> Finding:
    """Return a sentence if an attack falls short of the reference ensemble by more than the paired interval.

    The reference is the member with the highest mean loss, and for the score the one with the lowest mean quality. An
    attack falls short if the 95 % interval of the mean difference over images lies above `LOSS_SHORTFALL` of the rise
    of the reference, or above `QUALITY_SHORTFALL`.

    Args:
        comparisons: Comparisons of one attack, `MIN_PAIRS` or more.
        title: Description of the attack.
    """
    names = sorted(comparisons[0].references)
    reference_values = np.array([[comparison.references[name] for name in names] for comparison in comparisons])
    losses = np.array([comparison.loss for comparison in comparisons])
    clean_losses = np.array([comparison.loss_before for comparison in comparisons])
    qualities = np.array([comparison.quality for comparison in comparisons])
    strongest = int(reference_values[..., 0].mean(0).argmax())
    rise = float((reference_values[:, strongest, 0] - clean_losses).mean())
    shortfall, low, high = _mean_with_limits(reference_values[:, strongest, 0] - losses)
    if rise > 0 and low > LOSS_SHORTFALL * rise:
        return (
            f"{title} raises its loss by {float((losses - clean_losses).mean()):.3g} on {len(comparisons)} images, "
            f"{names[strongest]} with as many gradients by {rise:.3g}: it falls short by {shortfall / rise:.0%} "
            f"[{low / rise:.0%}, {high / rise:.0%}]"
        )
    most_harmful = int(reference_values[..., 1].mean(0).argmin())
    excess, low, high = _mean_with_limits(qualities - reference_values[:, most_harmful, 1])
    if low > QUALITY_SHORTFALL:
        return (
            f"{title} leaves an average precision of {float(qualities.mean()):.0%} on {len(comparisons)} images, "
            f"{names[most_harmful]} with as many gradients {float(reference_values[:, most_harmful, 1].mean()):.0%}: "
            f"it leaves {excess:.0%} [{low:.0%}, {high:.0%}] more"
        )
    return None


def _mean_with_limits(values: np.ndarray) -> tuple[float, float, float]:
    """Return the mean of values [N] and its limits; infinite ones where too few values differ for an interval."""
    if np.ptp(values) == 0.0:
        return float(values[0]), float(values[0]), float(values[0])
    limits = mean_limits(values, Clusters(np.ones(len(values)), np.zeros(len(values), np.intp)))
    low, high = float(limits.low), float(limits.high)
    return float(limits.mean), -math.inf if math.isnan(low) else low, math.inf if math.isnan(high) else high


RULES: Mapping[str, tuple[str, Rule]] = {
    "steps": ("more steps are never weaker", _steps),
    "radius": ("a larger budget is never weaker", _radius),
    "iterated": ("iterated attacks are at least as strong as a single step", _iterated),
    "reference": (
        "attacks are as strong as a reference ensemble (PGD, APGD, Square) with the same loss, budget and gradients",
        _reference,
    ),
    "losses": (
        f"the most steps that ran, if {MIN_STEPS} or more, are at least as strong as one on another loss",
        _losses,
    ),
    "access": ("white-box attacks are at least as strong as black-box ones", _access),
    "transfer": ("pictures made against another detector, or without its defence, are no stronger", _transfer),
    "restarts": ("restarts gain little", _restarts),
    "noise": ("attacks are stronger than noise of the same size", _above_noise),
    "unbounded": ("an unbounded budget leaves nothing", _unbounded),
    "loss": ("the ascended loss rises", _rises),
    "gradient": ("the gradient agrees with finite differences", _gradient),
    "coupling": ("images are attacked each by itself", _coupling),
    "budget": ("the budget holds in the stored pictures", _budget),
    "used": ("the budget is used", _used),
}
"""Name of a rule -> what it says, and how it is applied to the attempts on one detector."""
