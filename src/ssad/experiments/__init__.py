"""Kinds of experiments, a folder each.

A folder holds what one kind consists of: suite schema, cells, columns, page, verdict.
"""
