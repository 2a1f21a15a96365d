"""Metric layout of the objects of one frame."""
