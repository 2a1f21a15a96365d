"""Detectors (`nanodet`, `rtdetr`), segmenters (`rgbd`, `sam2`, `sam`), relation heads
(`geometric`, `egtr`): one module each.
"""
