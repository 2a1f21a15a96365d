"""Tools for every part of the package: files, text, kernels, times. It knows no scene."""
