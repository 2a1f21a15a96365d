"""Common parts of the backends with networks.

`image_tensors` makes the input of a network from an image, `box_prompts` is the base of SAM and
SAM 2, `nms` suppresses duplicate boxes, `calibration` makes class distributions from scores.
"""
