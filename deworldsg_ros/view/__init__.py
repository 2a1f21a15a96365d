"""Views of a scene graph: `table` for the terminal, `picture` from above as a PNG, `page` with a 3D
view as HTML, `markers` for RViz and Foxglove.
"""
