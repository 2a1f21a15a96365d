"""Checkpoints: loading, cards, and the import of published files."""
