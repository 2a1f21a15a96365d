"""No path of a data set, a bag or an index leaves its folder."""

from pathlib import Path

import pytest
from support.evaluation import write_dataset
from support.recordings import camera_items, write_bag, write_seven_scenes, write_tum

from deworldsg_ros.base.files import confined
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import read_file
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.replaying import write_mcap
from deworldsg_ros.scene.errors import ConfigurationError, RecordingError
from deworldsg_ros.training.clips import read_clip_folder

SECRET = b"root:x:0:0:secret"


@pytest.fixture
def secret(tmp_path):
    path = tmp_path / "secret.png"
    path.write_bytes(SECRET)
    return path


@pytest.mark.parametrize("name", ["../b", "/etc/passwd", "a/../../b", "link", "folder/b", "\0"])
def test_a_path_that_leaves_the_folder_is_refused_and_one_inside_is_as_it_was(tmp_path, name):
    folder = tmp_path / "real"
    folder.mkdir()
    (tmp_path / "f").symlink_to(folder)
    for link, target in (("link", "../b"), ("folder", tmp_path), ("inside", "a")):
        (folder / link).symlink_to(target)
    with pytest.raises(OSError):
        confined(tmp_path / "f", name)
    for inside in ("a", "x/../a", "x/y", "inside", str(folder / "a")):
        assert confined(tmp_path / "f", inside) == tmp_path / "f" / inside


def tum(folder: Path, secret: Path, name: str) -> None:
    """A folder in which this is the second colour image."""
    write_tum(folder)
    (folder / "rgb" / "link.png").symlink_to(secret)
    index = folder / "rgb.txt"
    index.write_text(index.read_text().replace("rgb/1.png", name))


def seven_scenes(folder: Path, secret: Path, suffix: str) -> None:
    """A folder in which this file of a frame is a link."""
    write_seven_scenes(folder, 3)
    (folder / f"frame-000004{suffix}").unlink()
    (folder / f"frame-000004{suffix}").symlink_to(secret)


@pytest.mark.parametrize(
    ("write", "what"),
    [
        (tum, "../secret.png"),
        (tum, "rgb/link.png"),
        (tum, "ABSOLUTE"),
        (seven_scenes, ".color.jpg"),
        (seven_scenes, ".depth.png"),
        (seven_scenes, ".pose.txt"),
    ],
)
def test_no_file_of_another_folder_is_converted(tmp_path, secret, write, what):
    write(tmp_path / "freiburg1", secret, str(secret) if what == "ABSOLUTE" else what)
    source = open_source(tmp_path / "freiburg1")
    write_mcap(source.raw_messages(), tmp_path / "out.mcap")
    assert SECRET not in (tmp_path / "out.mcap").read_bytes()
    assert sum(source.drops.values()) == 1


@pytest.mark.parametrize("name", ["metadata.yaml", "bag.mcap"])
def test_a_bag_reads_no_file_of_another_folder(tmp_path, name):
    other = write_bag(tmp_path / "other", camera_items(2))
    bag = write_bag(tmp_path / "bag", camera_items(2))
    (bag / "bag.mcap").unlink()
    if name == "bag.mcap":
        (bag / name).symlink_to(other / "other.mcap")
    else:
        (bag / name).write_text((bag / name).read_text().replace("bag.mcap", "../other/other.mcap"))
    with pytest.raises(RecordingError):
        open_source(bag)


@pytest.mark.parametrize("name", ["../x", "/etc", "..", "", "a/b"])
def test_a_scan_is_the_name_of_a_folder(tmp_path, name):
    annotations = Annotations(write_dataset(tmp_path, {"a": ([("chair", 1)], [])}), "replica")
    assert annotations.scan_folder("a").parent == tmp_path / "data"
    with pytest.raises(RecordingError, match="name of a folder"):
        annotations.scan_folder(name)


def test_files_of_data_sets_and_clips_are_no_links_to_elsewhere(tmp_path, secret):
    folder = tmp_path / "clips"
    folder.mkdir()
    (folder / "link").symlink_to(secret)
    with pytest.raises(RecordingError, match="leaves the folder"):
        read_file(folder / "link")
    line = '{"clip": "../secret.png", "predicate": "on", "group": "g"}'
    (folder / "index.jsonl").write_text(line)
    with pytest.raises(ConfigurationError, match="secret.png"):
        read_clip_folder(folder)
