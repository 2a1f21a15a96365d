"""The heap of a node's process."""

from __future__ import annotations

import platform
import subprocess
import sys

import pytest

# A heap of a thread has 64 MB of addresses; most of them are not in use, up to a multiple of 64 MB.
PROGRAM = """
import threading
{first}
import numpy
def fill():
    kept = [bytearray(5000) for _ in range(200)]
    both.wait()
both = threading.Barrier(5)
for _ in range(4):
    threading.Thread(target=fill).start()
both.wait()
unused = [line.split()[0] for line in open("/proc/self/maps") if line.split()[1] == "---p"]
bounds = [[int(end, 16) for end in addresses.split("-")] for addresses in unused]
print(sum(end % (64 << 20) == 0 and end - start > 32 << 20 for start, end in bounds))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other heaps")
def test_all_threads_of_a_node_use_one_heap():
    def heaps(first: str) -> int:
        command = [sys.executable, "-c", PROGRAM.format(first=first)]
        return int(subprocess.run(command, capture_output=True, check=True, timeout=60).stdout)

    assert heaps("") >= 4
    assert heaps("import deworldsg_ros.nodes") == 0
