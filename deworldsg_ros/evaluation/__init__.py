"""The official protocol, the measures beside it, replayable front ends, and what they print."""
