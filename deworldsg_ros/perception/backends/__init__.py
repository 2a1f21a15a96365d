"""Backends, one model a file."""
