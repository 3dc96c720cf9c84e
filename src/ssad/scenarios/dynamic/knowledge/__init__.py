"""The scenario classes: one module each, and what they share."""
