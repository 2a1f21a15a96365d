"""A frozen backbone with a trained probe."""
