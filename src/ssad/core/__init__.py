"""Data types, protocols and small tools shared by all other packages."""
