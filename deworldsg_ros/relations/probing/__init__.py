"""World models made of a frozen backbone and a trained probe, on torch.

- `preprocessing`: resizes, crops and normalises the frames of a clip.
- `backbone`: loads a backbone and turns clips into features.
- `probed_world_model`: backbone and probe together as a `WorldModel`.

The backbones themselves are in `relations/world_models`, the probe's network in `checkpoints`.
"""
