"""Sections of the report for kinds of experiment that have their own: a module each, named as the kind."""
