"""Checkpoints of pretrained networks: import, cards and loading. No stage is imported here.

- `catalogue`: published models by name, with source and licence; the checkpoints that a
  configuration needs, and how to get the missing ones.
- `hub`: downloads and verifies them, and reads names and shapes in a file.
- `cards`: how the outputs of a detector's and a probe's checkpoint are read.
- `loading`: finds a checkpoint, loads it with `transformers`, chooses device and precision.
- `egtr_network`: the network of the relation head EGTR.
- `fross`: imports a published FROSS checkpoint: detector and relation head.
- `probe_network`: the probe's network, saved, loaded and imported.

`catalogue`, `hub` and `cards` need no torch. All other modules are imported only if a network is
used.
"""
