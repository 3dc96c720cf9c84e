"""Static safety-critical scenarios: what changes in an image or a sweep, not in the traffic."""
