"""World models, one a file; each has `build(config: RelationsConfig) -> WorldModel | None`."""
