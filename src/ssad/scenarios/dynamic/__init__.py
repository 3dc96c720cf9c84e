"""Dynamic scenarios: eight pre-crash classes, natural junctions, and your own in YAML."""

from ssad.scenarios.dynamic.catalogue import CUSTOM, PRECRASH, SCENARIOS, parameter_box, scenario_type
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.importer import import_routes
from ssad.scenarios.dynamic.knowledge._kind import Parameter, ScenarioType
from ssad.scenarios.dynamic.parameters import scenario_parameters, with_parameters
from ssad.scenarios.dynamic.sampling import sample_parameters, sampling_ranges
from ssad.scenarios.dynamic.schema import scenario_data, scenario_from
from ssad.scenarios.dynamic.sets import load_scenarios, set_names
from ssad.scenarios.dynamic.yamlio import read_scenarios, save_scenarios, scenario_text

__all__ = [
    "CUSTOM",
    "PRECRASH",
    "SCENARIOS",
    "Parameter",
    "ScenarioType",
    "build_episode",
    "import_routes",
    "load_scenarios",
    "parameter_box",
    "read_scenarios",
    "sample_parameters",
    "sampling_ranges",
    "save_scenarios",
    "scenario_data",
    "scenario_from",
    "scenario_parameters",
    "scenario_text",
    "scenario_type",
    "set_names",
    "with_parameters",
]
