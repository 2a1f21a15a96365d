"""Training of probes: clips → features → fit → scores and a saved probe.

- `options`: options of a training.
- `labelled_clips`, `dataset_clips`, `scan_clips`: clips with predicates, from folders or data sets.
- `features`: features of clips, with a cache on disk.
- `split`: training, validation and held-out clips.
- `fit`: the fit, and the scores on held-out clips.
- `confusion`: the confusion matrix as a picture.
- `train`: all steps together.
"""
