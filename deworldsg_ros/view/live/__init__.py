"""The live viewer. Sources send updates and camera views to a `Viewer`.

`camera`, `history` and `state` decide what a page has to receive; they need no network. `server`
sends it. `foxglove` sends the graph to Foxglove. `sources` reads files and recordings; viewer_node
reads topics.
"""
