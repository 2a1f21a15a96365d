"""Relations from geometry: `layout` measures the objects of a frame, `predicates` judges pairs."""
