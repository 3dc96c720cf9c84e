"""Was an attack as strong as it could be? What the records of a run say against it, in plain sentences.

An attack that is badly tuned, follows a wrong gradient or breaks its budget leaves traces in its results: it grows
weaker with more steps, it is weaker than a single step, it is no stronger than noise. Source of most rules: Carlini et
al., On Evaluating Adversarial Robustness (2019), section 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

NOISE = 0.02  # share of the clean score that two attacks may differ by without meaning
LEFT = 0.05  # share of the clean score under which an attack has done its work
RESTARTS = 0.05  # share of the clean score that restarts may take away besides
GRADIENT = 0.25  # relative error of a gradient; that of losses with a detached target is up to a fifth
COUPLED = 0.01  # relative change of an image's loss by another image of the batch
USED = 0.25  # share of its budget that an attack uses at least, unless it has done its work
MANY = 5  # steps from which an attack is expected to beat a single step on any loss
WHOLE = frozenset({"full", "classification", "vanish", "margin"})  # losses about all that a detector finds
UNBOUNDED = 64.0  # code values from which an L-infinity budget hides any picture


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attack on one detector, as its record tells it; what it does not tell is None.

    Attributes:
        detector: name.
        attack: name; "noise" for random noise of the size of the budget.
        score: of the detector under it (mAP).
        clean: of the detector without it.
        loss: what was ascended; "" where nobody says.
        norm, radius: of the budget, 8-bit code values.
        steps: gradient steps of one start.
        access: "white-box", "black-box", "none".
        options: further settings, as text; `restarts` is read from it.
        draws: bootstrap replicates of the score, paired between attempts.
        before, after: mean of the ascended loss.
        gradient_error, coupling, used, change: see `ssad.experiments.perception.digital.attacked_scenes`.
        source: what the pictures were made against, if it was not what they are shown to.
        group: what else must be equal for scores to be compared, such as a defence or a target; part of what the
            sentences call the detector.
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

    @property
    def restarts(self) -> int:
        """Random starts besides the first."""
        told = dict(pair.split("=", 1) for pair in self.options.split() if "=" in pair)
        return int(told.get("restarts", "0"))

    @property
    def title(self) -> str:
        """What a sentence calls it."""
        parts = [self.attack, f"on loss {self.loss}" if self.loss and self.attack != "noise" else ""]
        parts.append("" if self.attack == "noise" else f"with {self.steps} step{'s' if self.steps != 1 else ''}")
        parts.append(f"at {self.radius:g} px" + (" (L2)" if self.norm == "l2" else ""))
        parts.append(f"({self.options})" if self.options else "")
        parts.append(f"against {self.source}" if self.source else "")
        return " ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True)
class Fault:
    """What speaks against an attack: the rule it breaks, the detector, a sentence."""

    rule: str
    detector: str
    text: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What an audit found.

    Attributes:
        compared: rule -> how often it could be applied; 0 where the run has nothing that it needs.
        faults: all that were found.
    """

    compared: Mapping[str, int]
    faults: tuple[Fault, ...]

    @property
    def passed(self) -> bool:
        """Whether nothing speaks against the attacks, and something was looked at."""
        return not self.faults and any(self.compared.values())

    @property
    def text(self) -> str:
        """The verdict in a sentence or two."""
        left = [RULES[rule][0] for rule, count in self.compared.items() if not count]
        unseen = f" Not in this run: {'; '.join(left)}." if left else ""
        if not any(self.compared.values()):
            return f"Audit: nothing to look at.{unseen}"
        if self.passed:
            return f"Audit passed: {sum(self.compared.values())} comparisons, no fault.{unseen}"
        count = len(self.faults)
        return f"Audit: {count} fault{'s' if count > 1 else ''} in {sum(self.compared.values())} comparisons.{unseen}"


Finding = str | None  # a sentence, or None where a comparison found no fault
Rule = Callable[[Sequence[Attempt]], Iterator[Finding]]


def audit(attempts: Iterable[Attempt]) -> Verdict:
    """Apply all rules to the attempts of each detector.

    Args:
        attempts: Of one run; those without noise, black-box attacks, restarts and so on are judged by the rest.

    Returns:
        Verdict, with faults in the order of the rules.
    """
    by_detector: dict[str, list[Attempt]] = {}
    for one in attempts:
        by_detector.setdefault(", ".join(filter(None, [one.detector, one.group])), []).append(one)
    compared, faults = dict.fromkeys(RULES, 0), []
    for name, (_, rule) in RULES.items():
        for detector, own in by_detector.items():
            for text in rule(own):
                compared[name] += 1
                if text is not None:
                    faults.append(Fault(name, detector, text))
    return Verdict(compared, tuple(faults))


def weaker(one: Attempt, other: Attempt) -> bool:
    """Whether one attempt leaves a higher score than another, beyond noise.

    The margin for noise is a share (`NOISE`) of the clean score or two standard errors of the paired difference,
    whichever is larger.

    Args:
        one: The attempt that may be the weaker attack.
        other: The attempt to compare it with.

    Returns:
        True if `one` is the weaker attack.
    """
    slack = NOISE * max(one.clean, 0.0)
    if len(one.draws) == len(other.draws) > 1:
        pairs = zip(one.draws, other.draws, strict=True)
        differences = [a - b for a, b in pairs]
        mean = math.fsum(differences) / len(differences)
        spread = math.fsum((value - mean) ** 2 for value in differences) / (len(differences) - 1)
        slack = max(slack, 2.0 * math.sqrt(spread))
    return one.score > other.score + slack


def _pair(one: Attempt, other: Attempt, why: str) -> Finding:
    """The sentence if `one`, which should be the stronger, is weaker."""
    if not weaker(one, other):
        return None
    return f"{one.title} leaves {_percent(one.score)}, {other.title} {_percent(other.score)}: {why}"


def _percent(score: float) -> str:
    return f"{100 * score:.2f} mAP"


def _own(attempts: Sequence[Attempt]) -> list[Attempt]:
    """Attacks on what is shown the pictures, without the noise."""
    return [one for one in attempts if one.attack != "noise" and not one.source]


def _along(attempts: Sequence[Attempt], what: str) -> Iterator[tuple[Attempt, Attempt]]:
    """Neighbours, smaller and larger, that differ in one attribute only."""
    names = [n for n in ("attack", "loss", "norm", "radius", "steps", "options") if n != what]
    groups: dict[tuple[object, ...], list[Attempt]] = {}
    for one in _own(attempts):
        groups.setdefault(tuple(getattr(one, name) for name in names), []).append(one)
    for group in groups.values():
        ordered = sorted(group, key=lambda one: float(getattr(one, what)))
        yield from ((a, b) for a, b in pairwise(ordered) if getattr(a, what) < getattr(b, what))


def _method(one: Attempt) -> tuple[object, ...]:
    """An attack but for its steps."""
    return one.attack, one.loss, one.norm, one.radius, one.options


def _steps(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for fewer, more in _along(attempts, "steps"):
        yield _pair(more, fewer, "more steps made it weaker, so its steps are mis-tuned")


def _radius(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for small, large in _along(attempts, "radius"):
        yield _pair(large, small, "a larger budget made it weaker, so it does not use its budget")


def _iterated(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    own = [one for one in _own(attempts) if one.access == "white-box"]
    for single in own:
        for many in own:
            alike = (single.loss, single.norm, single.radius) == (many.loss, many.norm, many.radius)
            if alike and single.steps == 1 and many.steps > 1 and single.attack != many.attack:
                yield _pair(many, single, "an iterated attack weaker than a single step is mis-tuned")


def _losses(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    """A loss about one thing only, such as depth, may do less than a single step on the whole training loss.

    Losses need more or fewer steps to get going, so each attack is judged by the most steps that it ran with: where a
    curve over steps begins says nothing against where it ends.
    """
    own = [one for one in _own(attempts) if one.access == "white-box"]
    last = [one for one in own if not any(one.steps < more.steps and _method(one) == _method(more) for more in own)]
    for single in own:
        for many in last:
            alike = (single.norm, single.radius) == (many.norm, many.radius) and single.loss != many.loss
            if alike and single.steps == 1 and many.steps >= MANY and many.loss in WHOLE:
                yield _pair(many, single, "many steps weaker than one, even on another loss, are mis-tuned")


def _access(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for _, group in _sizes(attempts):
        sides = [[one for one in group if one.access == access] for access in ("white-box", "black-box")]
        if all(sides):
            white, black = (min(side, key=lambda one: one.score) for side in sides)
            yield _pair(white, black, "a black-box attack beats the best white-box one, so the gradient is masked")


def _transfer(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    def method(one: Attempt) -> tuple[object, ...]:
        words = [word for word in one.options.split() if not word.startswith("draws=")]
        return one.attack, one.loss, one.norm, one.radius, one.steps, words

    for other in (one for one in attempts if one.source):
        for own in _own(attempts):
            if method(own) == method(other):
                yield _pair(own, other, "what was made against something else hurts more, so the gradient is masked")


def _restarts(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one, other in combinations(_own(attempts), 2):
        few, many = sorted((one, other), key=lambda attempt: attempt.restarts)
        alike = all(getattr(few, name) == getattr(many, name) for name in ("attack", "loss", "norm", "radius", "steps"))
        if not alike or few.restarts == many.restarts:
            continue
        wrong = _pair(many, few, "restarts made it weaker, so the best start is not kept")
        if wrong is None and few.score - many.score > RESTARTS * few.clean and weaker(few, many):
            wrong = (
                f"{few.title} leaves {_percent(few.score)}, {many.title} {_percent(many.score)}: restarts gain much, "
                "so one start ends far from the best"
            )
        yield wrong


def _above_noise(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    """Attacks that do no better than random noise of the same size.

    A small budget may be too small to change anything, so an attack must beat noise only at its largest budget; at no
    budget may noise beat the attack.
    """
    pairs = [
        (noise, one)
        for noise, group in _sizes(attempts)
        for one in group
        if noise is not None and noise.score > LEFT * noise.clean
    ]
    largest: dict[tuple[object, ...], float] = {}
    for _, one in pairs:
        kind = one.attack, one.loss, one.norm, one.steps, one.options
        largest[kind] = max(one.radius, largest.get(kind, 0.0))
    for noise, one in pairs:
        last = one.radius == largest[one.attack, one.loss, one.norm, one.steps, one.options]
        beaten = weaker(one, noise) or (last and one.score >= noise.score)
        yield (
            None
            if not beaten
            else (
                f"{one.title} leaves {_percent(one.score)}, random noise of the same size {_percent(noise.score)}: "
                "it attacks nothing"
            )
        )


def _sizes(attempts: Sequence[Attempt]) -> Iterator[tuple[Attempt | None, list[Attempt]]]:
    """For each size of the budget the noise, if there is some, and the attacks."""
    groups: dict[tuple[str, float], list[Attempt]] = {}
    for one in attempts:
        groups.setdefault((one.norm, one.radius), []).append(one)
    for group in groups.values():
        yield next((one for one in group if one.attack == "noise"), None), _own(group)


def _unbounded(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in _own(attempts):
        if one.norm == "linf" and one.radius >= UNBOUNDED and one.steps > 1:
            yield (
                None
                if one.score <= LEFT * one.clean
                else (
                    f"{one.title} leaves {_percent(one.score)} of {_percent(one.clean)}: a budget that hides the "
                    "picture must leave nothing, so the loss stops before the detections do"
                )
            )


def _rises(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in _own(attempts):
        if one.before is not None and one.after is not None:
            rise = one.after - one.before
            if rise > 0 or (rise == 0 and one.score <= LEFT * one.clean):
                yield None
            elif rise < 0:
                yield f"{one.title}: the loss it ascends fell from {one.before:.4g} to {one.after:.4g}: a wrong sign"
            else:
                yield f"{one.title}: the loss it ascends did not move from {one.before:.4g}: the gradient is cut off"


def _gradient(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in _own(attempts):
        if one.gradient_error is not None:
            yield (
                None
                if one.gradient_error <= GRADIENT
                else (
                    f"{one.title}: its gradient differs from finite differences by {one.gradient_error:.0%}: it is "
                    "detached, or masked"
                )
            )


def _coupling(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in _own(attempts):
        if one.coupling is not None:
            yield (
                None
                if one.coupling <= COUPLED
                else (
                    f"{one.title}: an image's loss changes by {one.coupling:.0%} with what else is in its batch: "
                    "images are not attacked each by itself"
                )
            )


def _budget(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in attempts:
        if one.change is not None:
            yield (
                None
                if one.change <= one.radius * (1 + 1e-5) + 1e-6
                else (
                    f"{one.title}: a stored picture is {one.change:g} px from the clean one: the budget does not hold "
                    "after rounding"
                )
            )


def _used(attempts: Sequence[Attempt]) -> Iterator[Finding]:
    for one in _own(attempts):
        if one.used is not None and one.score > LEFT * one.clean:
            yield (
                None
                if one.used >= USED
                else (
                    f"{one.title} uses {one.used:.0%} of its budget and leaves {_percent(one.score)}: its steps are "
                    "too small"
                )
            )


RULES: Mapping[str, tuple[str, Rule]] = {
    "steps": ("more steps are never weaker", _steps),
    "radius": ("a larger budget is never weaker", _radius),
    "iterated": ("iterated attacks are at least as strong as a single step", _iterated),
    "losses": (f"the most steps that ran, if {MANY} or more, are at least as strong as one on another loss", _losses),
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
