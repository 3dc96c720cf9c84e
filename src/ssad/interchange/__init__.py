"""Other simulators and scenario formats, behind the protocols of SSAD."""
