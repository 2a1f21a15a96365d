"""What every part of the package may use: files, text, kernels, times. It knows no scene."""
