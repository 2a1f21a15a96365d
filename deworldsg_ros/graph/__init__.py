"""The global graph: its nodes and pairs, edits, messages, publication and files."""
