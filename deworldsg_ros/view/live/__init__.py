"""The live viewer. Sources send updates and camera views to a `Viewer`.

`history`, `tables`, `drawing`, `labels`, `filters`, `details`, `crops` and `camera` compute what is
shown, without a browser. `scene`, `panel`, `client_labels` and `server` show it with viser.
`foxglove` sends it to Foxglove. `sources` reads files and recordings; viewer_node reads topics.
"""
