"""Static safety-critical scenarios: changes of an image or a LiDAR sweep, not of the traffic."""
