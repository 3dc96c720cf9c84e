"""Leading sentences of a page: the common parts of all verdicts."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from ssad.metrics import CaseValue, estimate
from ssad.report.load import Run
from ssad.report.records import Line, metric_cell, metric_of


def complete_verdict(run: Run, sentences: Sequence[str]) -> list[str]:
    """Return the sentences of a kind after the state of the run, and a default where there are none."""
    state_sentences = []
    if len(run.lines) < run.planned:
        state_sentences.append(f"Not finished: {len(run.lines)} of {run.planned} cells have run.")
    if not run.sealed:
        state_sentences.append("The records have no seals: changes to them would not be noticed.")
    return [sentence for sentence in [*state_sentences, *sentences] if sentence] or ["See the table."]


def worst_condition(subject: str, metric: str, scores: Mapping[str, float], condition_noun: str) -> str:
    """Return in a sentence the clean score ("") and the lowest of the others."""
    perturbed_scores = {
        name: value for name, value in scores.items() if name and name != "clean" and not math.isnan(value)
    }
    clean_score = scores.get("", scores.get("clean", math.nan))
    if not perturbed_scores or math.isnan(clean_score):
        return ""
    name = min(perturbed_scores, key=lambda condition: perturbed_scores[condition])
    if perturbed_scores[name] >= clean_score:
        return f"{subject}: {metric} {clean_score:.0%} clean; no {condition_noun} takes any of it."
    return (
        f"{subject}: {metric} {clean_score:.0%} clean; the {condition_noun} that costs most is {name}, "
        f"which leaves {perturbed_scores[name]:.0%}."
    )


def event_sentence(subject: str, verb: str, lines: Sequence[Line], metric: str, *, rate: str, noun: str) -> str:
    """Return in how many of the cells that ran an event happened, and what the failed ones leave open.

    Args:
        subject: System or detector.
        verb: Verb with its preposition, such as "collided in".
        lines: Lines of the subject, those of failed cells too.
        metric: Metric that is 1 where the event happened.
        rate: Name of the share, such as "collision rate".
        noun: Name of the cells in the plural, such as "drives".

    Returns:
        The sentence without a full stop.
    """
    cell = metric_cell(lines, metric, "share")
    completed_lines = [line for line in lines if line["status"] == "ok"]
    if not completed_lines:
        return f"{subject} has no {rate}: all of its {len(lines)} {noun} failed"
    events = sum(metric_of(line, metric) == 1.0 for line in completed_lines)
    sentence = f"{subject} {verb} {events} of {len(completed_lines)} {noun}"
    if failed := len(lines) - len(completed_lines):
        sentence += f"; {failed} more failed, so its {rate} lies in {cell.interval} whatever they were"
    return sentence


def lines_by(run: Run, field: str, *, failed: bool = False) -> dict[str, list[Line]]:
    """Group the lines of a run by a field; `failed`: those of failed cells too."""
    lines_by_value: dict[str, list[Line]] = {}
    for line in run.lines:
        if line["status"] == "ok" or failed:
            lines_by_value.setdefault(str(line.get(field) or ""), []).append(line)
    return lines_by_value


def mean_of(values: Iterable[float]) -> float:
    """Return the mean of the values that are not NaN; NaN where there are none."""
    cases = [CaseValue(value, str(index), str(index)) for index, value in enumerate(values) if not math.isnan(value)]
    return estimate(cases, "mean").mean if cases else math.nan
