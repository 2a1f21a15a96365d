"""A scene graph for people: tables, a picture, a page with the 3D view, markers for RViz."""
