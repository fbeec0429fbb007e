"""Reads logs: tables with one row per control step."""
