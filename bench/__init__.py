"""Measurements: what memory can give, what we reach, what others reach, in one run.

Importing this imports no case, peer or report: each module is imported where it is used.
"""
