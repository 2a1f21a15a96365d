"""The official protocol and its input formats."""
