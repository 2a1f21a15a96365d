"""The JSON messages of all topics: their types, their codec, and following a graph."""
