"""Identification from files: a configuration, and measured recordings."""
