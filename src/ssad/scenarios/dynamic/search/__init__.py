"""Black-box searches over a scenario's parameter box: the baselines of all other generators."""
