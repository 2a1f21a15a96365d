"""Data set folders as recordings: one module per data set, detected by the files of the folder.

`dataset` is the base class, and finds the data sets. `frame_files` reads folders with a few files
per frame: `seven_scenes`, and `sequence` with the layout of 3RScan. `tum` reads TUM RGB-D.
`annotations` reads the ground truth.
"""
