"""Kinds of experiments, a folder each.

A folder holds all parts of one kind: suite schema, cells, columns, page, verdict.
"""
