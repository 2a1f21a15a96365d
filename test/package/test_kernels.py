"""All kernels of a run are compiled before its first frame, each for one layout."""

import itertools
import json
import subprocess
import sys

import pytest
from numba.core.dispatcher import Dispatcher

from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.pipeline import Pipeline
from deworldsg_ros.recordings.recording import open_recording

# By then a surface was seen through, and relations were inferred.
FRAMES = 60


def signatures() -> dict[str, set[object]]:
    modules = [module for name, module in sys.modules.items() if name.startswith("deworldsg_ros.")]
    kernels = {item for module in modules for item in vars(module).values()
               if isinstance(item, Dispatcher)}  # fmt: skip
    return {f"{k.__module__}.{k.__name__}": set(k.signatures) for k in kernels}


@pytest.mark.slow
def test_no_frame_waits_for_the_compiler(root_dir):
    pipeline = Pipeline(Config())
    pipeline.lifting.warm_up()
    warm_up(Config())
    before = signatures()
    assert len(before) > 60
    recording = open_recording(root_dir / "bags" / "demo_room")
    for frame in itertools.islice(recording.frames(), FRAMES):
        pipeline.process(frame)
        assert pipeline.builder is not None
        pipeline.builder.update()
    recording.close()
    late = {name: found - before.get(name, set()) for name, found in signatures().items()}
    assert {name: found for name, found in late.items() if found} == {}


FIRST_CALLS = """
import threading
import numpy as np
from deworldsg_ros.scene import surface
begin, done = threading.Barrier(4), []
def call():
    begin.wait()
    points, counts = np.zeros((1, 8, 3), np.float32), np.zeros(1, np.int64)
    known, new = np.zeros((1, 8), np.uint16), np.zeros(3, np.uint16)
    sets = [np.ones((3, 3), np.float32)]
    surface.add_points(points, known, counts, np.array([0]), sets, new)
    done.append(counts.tolist())
threads = [threading.Thread(target=call) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(done)
"""


def test_threads_may_call_a_kernel_for_the_first_time_together():
    done = subprocess.run(
        [sys.executable, "-c", FIRST_CALLS], capture_output=True, text=True, check=True
    )
    assert (done.stderr, json.loads(done.stdout)) == ("", [[1]] * 4)


START = """
from deworldsg_ros.base.kernels import on_compilation
from deworldsg_ros.config import Config
from deworldsg_ros.graph_builder import warm_up
from deworldsg_ros.lifting.stage import Lifting
from deworldsg_ros.perception.registry import build_perception
compiled = []
on_compilation(lambda: compiled.append(True))
warm_up(Config())
Lifting(Config().lifting).warm_up()
build_perception(Config().perception)
print(compiled != [])
"""


@pytest.mark.slow
def test_a_second_start_compiles_nothing():
    command = [sys.executable, "-c", START]
    starts = [subprocess.run(command, capture_output=True, text=True, check=True) for _ in "ab"]
    assert starts[1].stdout.split() == ["False"], starts[1].stderr


@pytest.mark.parametrize(
    "modules",
    [
        "deworldsg_ros.cli.app, deworldsg_ros.cli.demo, deworldsg_ros.client",
        "deworldsg_ros.nodes.graph_node",
        "deworldsg_ros.nodes.relation_node",
        "deworldsg_ros.nodes.lifting_node, deworldsg_ros.nodes.segmentation_node",
        "deworldsg_ros.nodes.replay_node, deworldsg_ros.nodes.deworldsg_node",
    ],
)
def test_a_start_imports_nothing_slow_that_it_may_not_need(modules):
    slow = {"numba", "scipy", "matplotlib", "onnxruntime", "numpy.ma"}
    if "graph_node" in modules:
        slow |= {"cv2"}
    if "cli" in modules:
        slow |= {"deworldsg_ros.pipeline", "rclpy"}
    code = f"import sys, {modules}; print(*({slow} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


CALLED = '''
from deworldsg_ros.base.kernels import kernel
STEP = {step}
@kernel
def called(x):
    """{documentation}"""
    return x + STEP
'''
CALLING = """
from called import called
from deworldsg_ros.base.kernels import kernel
@kernel
def calling(x):
    return 2 * called(x)
"""
CALL = """
import sys
sys.path.insert(0, sys.argv[1])
from deworldsg_ros.base.kernels import on_compilation
compiled = []
on_compilation(lambda: compiled.append(True))
from calling import calling
print(calling(1), compiled != [])
"""


def test_a_kernel_is_compiled_again_if_one_that_it_calls_in_another_file_changed(tmp_path):
    def call(step: int, documentation: str) -> list[str]:
        text = CALLED.format(step=step, documentation=documentation)
        (tmp_path / "called.py").write_text(text, encoding="utf-8")
        command = [sys.executable, "-B", "-c", CALL, str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()

    (tmp_path / "calling.py").write_text(CALLING, encoding="utf-8")
    assert call(1, "One.") == ["4", "True"]
    assert call(1, "One.") == ["4", "False"]
    assert call(1, "Another text, and\n    another line.") == ["4", "False"]
    assert call(5, "One.") == ["12", "True"]


OF_A_RELEASE = """
from typing import NamedTuple
from deworldsg_ros.base.kernels import kernel
class {name}(NamedTuple):
    x: float
@kernel
def doubled(item):
    return {factor} * item.x
print(doubled({name}(2.0)))
"""


def test_what_another_release_has_compiled_does_not_end_the_program(tmp_path):
    """The types of its kernels may be no more."""
    for name, factor, result in (("Frame", 2, "4.0"), ("View", 3, "6.0"), ("Frame", 2, "4.0")):
        text = OF_A_RELEASE.format(name=name, factor=factor)
        (tmp_path / "release.py").write_text(text, encoding="utf-8")
        code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import release"
        command = [sys.executable, "-B", "-c", code]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.stdout.split() == [result], done.stderr
