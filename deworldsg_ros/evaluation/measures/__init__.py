"""Measures beside the protocol: precision, duplicates, positions, steadiness."""
