"""`deworldsg doctor`: say what is off with a recording, or with the nodes that run now."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console

from deworldsg_ros.cli.observing import print_findings
from deworldsg_ros.cli.run import RunOptions, examine
from deworldsg_ros.doctor import Finding, find

NOTHING = "nothing is off"


def examine_recording(options: RunOptions, console: Console) -> bool:
    """Run a recording without results and print the findings; whether all is well."""
    return _told(examine(options, console), console)


def examine_nodes(seconds: float, console: Console) -> bool:
    """Listen to running nodes and print the findings; whether all is well."""
    from deworldsg_ros.ros.observing import observe_nodes

    with console.status(f"listening for {seconds:g} s …"):
        seen = observe_nodes(seconds)
    return _told(find(seen), console)


def _told(findings: Sequence[Finding], console: Console) -> bool:
    print_findings(console, findings)
    is_well = all(finding.harmless for finding in findings)
    if is_well:
        console.print(NOTHING, highlight=False)
    return is_well
