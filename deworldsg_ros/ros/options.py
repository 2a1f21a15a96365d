"""Everything that a node can be told."""

from typing import Annotated

import msgspec

from deworldsg_ros.config import Config, option


class NodeOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a node runs, apart from what it computes."""

    queue_size: Annotated[
        int,
        option(
            "frames that may wait for this node's work; the oldest goes: overrun",
            ge=1,
            le=100000,
        ),
    ] = 10
    patience_s: Annotated[
        float,
        option(
            "longest time a frame waits for depth, camera_info or pose, seconds",
            gt=0,
            le=3600,
        ),
    ] = 5.0
    save_path: Annotated[str, option("file that graph_node's service ~/save writes")] = (
        "scene_graph.json"
    )
    map_path: Annotated[
        str,
        option(
            "map that graph_node goes on with, where the file is there, and that "
            "~/save and a clean end write; empty = none. Poses have to be in the same world frame"
        ),
    ] = ""


class Parameters(Config, frozen=True, forbid_unknown_fields=True):
    """Everything that a node can be told: the configuration and how it runs."""

    node: NodeOptions = NodeOptions()
