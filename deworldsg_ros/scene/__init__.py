"""The nouns: cameras and frames, Gaussians, frame graphs, the global graph, messages, errors."""
