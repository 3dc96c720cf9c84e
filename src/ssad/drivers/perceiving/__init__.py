"""A driving system that knows of traffic only what its cameras show; each part can be replaced."""
