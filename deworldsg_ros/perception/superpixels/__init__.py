"""Parts of the segmenter `rgbd`, which cuts an image into regions and assigns them to boxes.

`regions` finds the regions of a reduced image, `box_cut` assigns them to the objects, and
`mask_upsampling` turns them into masks of pixels.
"""
