"""Superpixels of an RGB-D image, and the cut that assigns them to an object."""
