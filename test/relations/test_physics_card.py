"""The card of the world model `physics`: weights, code, and training again."""

import hashlib
import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deworldsg_ros.evaluation.recorded_room import RecordedRoom
from deworldsg_ros.relations import physics

TOOLS = Path(__file__).resolve().parents[2] / "tools" / "physics_model"
CARD = json.loads((TOOLS / "card.json").read_text())
OLD_PROCESSOR = {"ATEN_CPU_CAPABILITY": "default", "OPENBLAS_CORETYPE": "Prescott"}
WHAT_TO_DO = (
    "The inputs of the world model 'physics' are not those of its card. Measure the weights on "
    "maps of today's code (tools/physics_model/README.md). If the figures are as good as those of "
    "card.json, renew it: measure.py --renew. If not, train again."
)


@pytest.fixture(scope="module")
def fingerprint():
    """tools/physics_model/fingerprint.py as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOLS)
        yield importlib.import_module("fingerprint")


@pytest.fixture(scope="module")
def room_map(fingerprint, tmp_path_factory):
    """A map of the shipped recording with true boxes."""
    return fingerprint.map_recording(tmp_path_factory.mktemp("maps"))


def test_the_card_is_that_of_the_shipped_weights():
    digest = hashlib.sha256(physics.PATH.read_bytes()).hexdigest()
    assert CARD["weights_sha256"] == digest, "train.py and measure.py --renew write the card"


def test_the_card_fits_the_code(fingerprint, room_map):
    seen = fingerprint.of_map(room_map)
    scales = physics.load_physics_model().input_scales
    changed = fingerprint.differences(CARD["fingerprint"], seen, scales)
    assert not changed, "\n".join([WHAT_TO_DO, *changed])


def test_a_stage_that_changed_is_told(fingerprint, room_map, tmp_path):
    """Surfaces with 2 cm more noise do not fit; a tenth of a millimetre does not matter."""
    known, scales = fingerprint.of_map(room_map), physics.load_physics_model().input_scales
    for noise_m, fits in ((1e-4, True), (0.02, False)):
        arrays = dict(np.load(room_map))
        points = arrays["surface_points"]
        points += np.random.default_rng(0).normal(0, noise_m, points.shape).astype(points.dtype)
        np.savez(tmp_path / "changed.npz", **arrays)
        seen = fingerprint.of_map(tmp_path / "changed.npz")
        assert (fingerprint.differences(known, seen, scales) == []) == fits


@pytest.mark.models
@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_training_again_gives_the_same_weights(fingerprint, room_map, tmp_path):
    """Also with other sums: other threads, and a processor without vector instructions."""
    pytest.importorskip("torch")
    truth = RecordedRoom(fingerprint.RECORDING).ground_truth("demo_room")
    maps, rooms = tmp_path / "maps", tmp_path / "rooms"
    maps.mkdir()
    for number in range(4):
        folder = rooms / "data" / f"room_{number}"
        folder.mkdir(parents=True)
        (folder / "gt.json").write_text(json.dumps(truth))
        shutil.copy(room_map, maps / f"room_{number}.npz")
    made = []
    for name, threads, processor in (("one", "2", {}), ("other", "1", OLD_PROCESSOR)):
        path = tmp_path / f"{name}.npz"
        command = [sys.executable, TOOLS / "train.py", "--train", maps, rooms, "--out", path]
        variables = {"PYTHONPATH": str(TOOLS.parents[1]), "OMP_NUM_THREADS": threads}
        subprocess.run(command, check=True, env=os.environ | variables | processor)
        made.append(np.load(path))
        assert json.loads(path.with_suffix(".json").read_text())["training"]["related"] == 64
    for name in made[0].files:
        np.testing.assert_allclose(made[0][name], made[1][name], rtol=0, atol=1e-6, err_msg=name)
