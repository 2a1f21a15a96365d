"""The nouns: cameras, frames, Gaussians, surfaces, the graphs of a frame, vocabularies, errors."""
