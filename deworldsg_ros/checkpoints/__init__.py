"""Checkpoints of pretrained networks: import, cards and loading. No stage is imported here.

- `catalogue`: published models by name, with source and licence.
- `hub`: downloads and verifies them. `headers`: names and shapes in a file.
- `required`: the checkpoints that a configuration needs, and how to get the missing ones.
- `loading`: finds a checkpoint, loads it with `transformers`, chooses device and data type.
- `precision`: compares half with single precision at start-up, and refuses NaN.
- `card`: `deworldsg.json`, how a detector's checkpoint is read.
- `architectures`: detector classes by model type, and the file name of the relation head.
- `egtr_network`: the network of the relation head EGTR.
- `fross`: imports a published FROSS checkpoint: detector and relation head.
- `fross_names`: names of its parameters in the published file and in `transformers`.
- `probe_card`: `config.json` of a probe: its backbone and its predicates.
- `probe_network`: the probe's network, saved and loaded.
- `published_probe`: imports the published probe of V-JEPA 2.

`catalogue`, `hub`, `required` and the cards need no torch. All other modules are imported only if a
network is used.
"""
