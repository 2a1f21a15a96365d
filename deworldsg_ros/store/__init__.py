"""A scene graph and its history in a graph database (the extra `store`).

A store is a folder. `messages.jsonl` has the JSON messages of the graph, as they came: they are the
truth. `graph.lbug` is a database of ladybug that is made from them, and can be made anew.
"""

from deworldsg_ros.scene.errors import StoreError
from deworldsg_ros.store.store import Store

__all__ = ["Store", "StoreError"]
