"""Reads and writes models, parameter files and effects files."""
