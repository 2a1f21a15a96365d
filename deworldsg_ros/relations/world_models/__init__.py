"""World models, one per file, each with `build(config: RelationsConfig) -> WorldModel | None`."""
