"""Data types, protocols and small tools that every other package may use."""
