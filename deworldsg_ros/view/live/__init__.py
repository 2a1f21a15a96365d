"""The live viewer. Sources send updates and camera views to a `Viewer`.

`camera` and `state` compute what a page is told, without a network; `server` tells it. `foxglove`
sends the graph to Foxglove. `sources` reads files and recordings; viewer_node reads topics.
"""
