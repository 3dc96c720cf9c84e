"""Safety-critical scenarios: dynamic ones change the traffic, static ones what the sensors measure."""
