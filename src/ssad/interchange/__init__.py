"""Other simulators and formats, behind the protocols of SSAD."""
