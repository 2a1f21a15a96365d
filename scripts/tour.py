"""A tour: a recording becomes a graph, which is asked, corrected, exported, compared and merged.

scripts/tour starts it with its environment.
"""

from __future__ import annotations

import asyncio
import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from deworldsg_ros.client import SceneGraph
from deworldsg_ros.client.combine import combine
from deworldsg_ros.scene.camera import rigid_motion
from deworldsg_ros.wire import messages as wire

ROOT = Path(__file__).resolve().parents[1]
COMMAND = [sys.executable, "-m", "deworldsg_ros.cli"]


def deworldsg(*arguments: object) -> str:
    """Run a command, print it, and return its output."""
    words = list(map(str, arguments))
    print(f"\n$ deworldsg {shlex.join(words)}", flush=True)
    done = subprocess.run([*COMMAND, *words], stdout=subprocess.PIPE, text=True, check=True)
    print(done.stdout, end="", flush=True)
    return done.stdout


def ask_in_python(folder: Path) -> SceneGraph:
    """Three questions from Python."""
    graph = SceneGraph.load(folder)
    print("\n>>> which cup is on the table, where")
    for cup in graph.on("dining table", "cup"):
        print(cup.name, cup.position_m, cup.size_m, f"{cup.probability:.0%}")
    print(">>> what is near the cup")
    for item, gap_m in graph.neighbours("cup", within=0.3):
        print(item.name, f"{gap_m:.2f} m")
    print(">>> why is it there")
    print(graph.explain("cup"))
    return graph


def ask_as_an_agent(folder: Path) -> None:
    """Three questions over MCP."""
    try:
        import mcp
    except ImportError:
        print("\nMCP: skipped, the package mcp is not installed")
        return
    server = mcp.StdioServerParameters(
        command=COMMAND[0], args=[*COMMAND[1:], "mcp", str(folder)], env=dict(os.environ)
    )

    async def talk() -> None:
        async with mcp.Client(server) as client:
            questions: list[tuple[str, dict[str, Any]]] = [
                ("find", {"question": "cup on dining table"}),
                ("list_relations", {"predicate": "on", "limit": 3}),
                ("goal_near", {"object": "cup", "distance_m": 0.8}),
            ]
            for name, arguments in questions:
                result = await client.call_tool(name, arguments)
                text = result.content[0].text
                print(f"\nMCP {name} {arguments}\n{text[:300]} …")
                assert not result.is_error and json.loads(text)

    asyncio.run(talk())


def correct_by_hand(out: Path, cup_id: int) -> None:
    """An operator's edits: in the map file, and through the services of a node."""
    room = out / "room.map"
    deworldsg("edit", room, "set_label", cup_id, "my mug")
    deworldsg("edit", room, "delete", cup_id)
    deworldsg("edit", room, "undo")
    try:
        from deworldsg_ros.client import SceneGraphClient
    except ImportError:
        print("\nservices: skipped, ROS 2 is not installed")
        return
    values = {"map_path": room.absolute(), "save_path": (out / "edited.json").absolute()}
    options = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    command = [COMMAND[0], "-m", "deworldsg_ros.nodes.graph_node", "--ros-args", *options]
    node = subprocess.Popen(command)
    try:
        with SceneGraphClient() as client:
            mug = client.wait(timeout_s=120.0)[cup_id]
            print(f"\n>>> {mug.name} is in the running graph")
            print(f"labelled by hand: {mug.is_labelled_by_hand}")
            assert mug.label == "my mug" and mug.is_labelled_by_hand
            table = client.graph.one("dining table").id
            for answer in (
                client.split(table),
                client.undo(),
                client.command("goal_near", object=cup_id, distance_m=0.8),
            ):
                print(str(answer)[:200])
            print(client.save())
    finally:
        node.send_signal(signal.SIGINT)
        node.wait(30)
    deworldsg("diff", out / "first", out / "edited.json")


def main() -> None:
    """Run all steps; the first one that fails ends the tour."""
    recording = sys.argv[1] if len(sys.argv) > 1 else ROOT / "bags" / "demo_room"
    out = Path(sys.argv[2] if len(sys.argv) > 2 else "tour_out")
    more = sys.argv[3:]
    deworldsg("run", recording, "--out", out / "first", "--map", out / "room.map", *more)
    graph = ask_in_python(out / "first")
    assert len(graph) > 0

    for question in ("cup on dining table", "chair within 0.5 m of table", "banana"):
        deworldsg("query", out / "first", question)
    deworldsg("goal", out / "first", "cup", "--distance", 0.8)
    ask_as_an_agent(out / "first")
    correct_by_hand(out, graph.one("cup").id)

    for kind, name in (
        ("graphml", "graph.graphml"),
        ("csv", "graph.csv"),
        ("ply", "graph.ply"),
        ("spark_dsg", "graph_spark_dsg.json"),
    ):
        deworldsg("export", kind, out / "first", out / name)

    # Another session: the same room in another world frame, and without one object.
    T = rigid_motion(np.array([2.0, -1.0, 0.0]), np.array([0.0, 0.0, 0.7]))
    nodes = [node for node in graph.message.nodes if node.id != graph.one("cup").id]
    moved = combine(SceneGraph(msgspec.structs.replace(graph.message, nodes=[], edges=[])),
                    SceneGraph(msgspec.structs.replace(graph.message, nodes=nodes)), T)  # fmt: skip
    (out / "second.json").write_text(wire.encode(moved.message), encoding="utf-8")
    merged = deworldsg("merge", out / "first", out / "second.json", out / "merged.json")
    assert "confidence" in merged
    back = deworldsg(
        *("merge", out / "second.json", out / "first", out / "back.json"),
    )
    assert "transform found" in back
    difference = deworldsg("diff", out / "first", out / "merged.json")
    assert "gone" not in difference
    print(f"\nThe files are in {out}.")


if __name__ == "__main__":
    main()
