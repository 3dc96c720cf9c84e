"""An example of a package for SSAD: one file a thing; pyproject.toml gives them their names."""
