"""What scripts/requirements.py prints."""

import subprocess
import sys
from pathlib import Path

from packaging.requirements import Requirement


def required(root: Path, *extras: str) -> list[Requirement]:
    command = [sys.executable, str(root / "scripts" / "requirements.py"), *extras]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return [Requirement(line) for line in done.stdout.split()]
