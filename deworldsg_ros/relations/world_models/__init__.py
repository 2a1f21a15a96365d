"""World models of clips, one per file; `world_model.WORLD_MODELS` has their names."""
