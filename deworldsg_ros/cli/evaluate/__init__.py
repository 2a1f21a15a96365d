"""`deworldsg evaluate`: scene graphs measured against annotations."""
