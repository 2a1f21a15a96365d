"""Detectors (`embedded`, `closed_set`, `open_vocabulary`), segmenters (`rgbd`, `sam`), relation
heads (`geometric`, and `egtr` in `closed_set`).
"""
