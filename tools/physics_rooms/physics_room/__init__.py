"""Simulated rooms: shapes, furniture, layout, physics, truth, pictures and files."""
