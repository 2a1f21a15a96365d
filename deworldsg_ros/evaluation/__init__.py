"""Evaluation: the official protocol, measures beside it, front ends, baselines, tables."""
