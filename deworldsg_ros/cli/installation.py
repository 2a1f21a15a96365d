"""Find the files and executables of the package, in a checkout or an installation."""

from __future__ import annotations

import contextlib
import os
import sys
from pathlib import Path

import deworldsg_ros

PACKAGE = "deworldsg_ros"


def checkout() -> Path | None:
    """Root of the source tree if the package runs from one; None for an installation."""
    root = Path(deworldsg_ros.__file__).resolve().parents[1]
    return root if (root / "package.xml").exists() else None


def prefixes() -> list[Path]:
    """Installation prefixes that may hold the package, best first."""
    found: list[Path] = []
    # ament_index_python raises if AMENT_PREFIX_PATH is not set or does not contain the package.
    with contextlib.suppress(Exception):
        from ament_index_python.packages import get_package_prefix

        found.append(Path(get_package_prefix(PACKAGE)))
    return [*found, Path(sys.prefix)]


def find_shared(relative: str) -> Path | None:
    """A file or folder of the share folder, e.g. ``config/paper.yaml``; None if it is missing."""
    source = checkout()
    folders = [source] if source else []
    folders += [prefix / "share" / PACKAGE for prefix in prefixes()]
    return next((folder / relative for folder in folders if (folder / relative).exists()), None)


def dds_environment() -> dict[str, str]:
    """Environment of the nodes: this machine, its own domain, shared memory for images."""
    environment = dict(os.environ)
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    # Domains above 101 collide with ephemeral ports on Linux.
    environment.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    # The wheels of ROS 2 do not set it, and rclpy looks for its type support there.
    environment.setdefault("AMENT_PREFIX_PATH", sys.prefix)
    profile = find_shared("config/fastdds.xml")
    if profile is not None:
        environment.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(profile))
    environment["PYTHONUNBUFFERED"] = "1"
    return environment


def node_command(name: str) -> list[str]:
    """Command that starts a node: its installed executable, or its module."""
    if checkout() is None:
        for prefix in prefixes():
            executable = prefix / "lib" / PACKAGE / name
            if os.access(executable, os.X_OK):
                return [str(executable)]
    return [sys.executable, "-m", f"{PACKAGE}.nodes.{name}"]
