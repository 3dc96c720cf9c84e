"""Third-party detectors behind the `Detector` protocol."""
