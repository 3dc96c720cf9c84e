"""Metrics of episodes and their confidence intervals: pure functions from records to numbers."""

from ssad.metrics.aggregate import FAMILIES as FAMILIES
from ssad.metrics.aggregate import METRICS as METRICS
from ssad.metrics.aggregate import EpisodeOutcome as EpisodeOutcome
from ssad.metrics.aggregate import GroupRow as GroupRow
from ssad.metrics.aggregate import Metric as Metric
from ssad.metrics.aggregate import aggregate as aggregate
from ssad.metrics.aggregate import aggregate_groups as aggregate_groups
from ssad.metrics.driving import EpisodeMetrics as EpisodeMetrics
from ssad.metrics.driving import episode_metrics as episode_metrics
from ssad.metrics.driving import frea_score as frea_score
from ssad.metrics.driving import overall_score as overall_score
from ssad.metrics.uncertainty import CaseValue as CaseValue
from ssad.metrics.uncertainty import Estimate as Estimate
from ssad.metrics.uncertainty import estimate as estimate
from ssad.metrics.uncertainty import paired_difference as paired_difference
from ssad.metrics.uncertainty import replicate_difference as replicate_difference
from ssad.metrics.uncertainty import replicate_estimate as replicate_estimate
from ssad.metrics.uncertainty import sign_flip_test as sign_flip_test
