"""Other people's detectors behind the `Detector` protocol."""
