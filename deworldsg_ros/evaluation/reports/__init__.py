"""Reports of an evaluation: JSON values, CSV and LaTeX files, plots, terminal tables."""
