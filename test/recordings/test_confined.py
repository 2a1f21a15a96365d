"""No path of a data set, a bag or an index leaves its folder."""

from __future__ import annotations

import pytest
from support.evaluation import write_dataset
from support.recordings import (
    camera_items,
    depth_mm,
    encoded,
    rgb_pixels,
    stamp_ns,
    write_bag,
    write_seven_scenes,
)

from deworldsg_ros.base.files import confined
from deworldsg_ros.recordings.folders.annotations import Annotations
from deworldsg_ros.recordings.folders.dataset import read_file
from deworldsg_ros.recordings.recording import open_source
from deworldsg_ros.recordings.writer import write_mcap
from deworldsg_ros.scene.errors import RecordingError

SECRET = b"root:x:0:0:secret"


@pytest.fixture
def secret(tmp_path):
    path = tmp_path / "secret.png"
    path.write_bytes(SECRET)
    return path


@pytest.mark.parametrize("name", ["../b", "/etc/passwd", "a/../../b", "link", "folder/b", "\0"])
def test_a_path_that_leaves_the_folder_is_refused(tmp_path, name):
    folder = tmp_path / "f"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "b")
    (folder / "folder").symlink_to(tmp_path)
    with pytest.raises(OSError):
        confined(folder, name)


def test_a_path_inside_is_as_it_was(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "f").symlink_to(tmp_path / "real")
    (tmp_path / "real" / "link").symlink_to("a")
    for name in ("a", "x/../a", "x/y", "link", str(tmp_path / "real" / "a")):
        assert confined(tmp_path / "f", name) == tmp_path / "f" / name


def test_a_file_of_a_data_set_is_no_link_to_elsewhere(tmp_path, secret):
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "link").symlink_to(secret)
    with pytest.raises(RecordingError, match="it leaves the folder .*: copy the file into it"):
        read_file(tmp_path / "d" / "link")


def write_tum(folder, name):
    """Three frames; the colour image of the second has this name."""
    (folder / "rgb").mkdir(parents=True)
    lines = {"rgb": [], "depth": [], "groundtruth": []}
    for index in range(3):
        stamp = f"{stamp_ns(index) / 1e9:.6f}"
        (folder / "rgb" / f"{index}.png").write_bytes(encoded(rgb_pixels(index)))
        (folder / "rgb" / f"{index}.depth.png").write_bytes(encoded(depth_mm(index) * 5))
        lines["rgb"].append(f"{stamp} {name if index == 1 else f'rgb/{index}.png'}")
        lines["depth"].append(f"{stamp} rgb/{index}.depth.png")
        lines["groundtruth"].append(f"{stamp} 0 0 0 0 0 0 1")
    for kind, text in lines.items():
        (folder / f"{kind}.txt").write_text("\n".join(text))
    return folder


@pytest.mark.parametrize("name", ["../secret.png", "rgb/link.png", "ABSOLUTE"])
def test_tum_converts_no_file_of_another_folder(tmp_path, secret, name):
    folder = write_tum(tmp_path / "freiburg1_x", str(secret) if name == "ABSOLUTE" else name)
    (folder / "rgb" / "link.png").symlink_to(secret)
    source = open_source(folder)
    write_mcap(source.raw_messages(), tmp_path / "out.mcap")
    assert SECRET not in (tmp_path / "out.mcap").read_bytes()
    assert source.drops["unreadable_file"] == 1
    assert "it leaves the folder" in source.losses[0]


@pytest.mark.parametrize("suffix", [".color.jpg", ".depth.png", ".pose.txt"])
def test_seven_scenes_reads_no_link_to_another_folder(tmp_path, secret, suffix):
    folder = write_seven_scenes(tmp_path / "chess", 3)
    (folder / f"frame-000004{suffix}").unlink()
    (folder / f"frame-000004{suffix}").symlink_to(secret)
    source = open_source(folder)
    write_mcap(source.raw_messages(), tmp_path / "out.mcap")
    assert SECRET not in (tmp_path / "out.mcap").read_bytes()
    assert sum(source.drops.values()) == 1


def test_a_bag_reads_no_link_to_another_folder(tmp_path):
    other = write_bag(tmp_path / "other", camera_items(2))
    bag = write_bag(tmp_path / "bag", camera_items(2))
    (bag / "bag.mcap").unlink()
    (bag / "bag.mcap").symlink_to(other / "other.mcap")
    with pytest.raises(RecordingError, match="it leaves the folder"):
        open_source(bag)


def test_metadata_of_a_bag_names_files_of_its_own_folder(tmp_path):
    write_bag(tmp_path / "other", camera_items(2))
    bag = write_bag(tmp_path / "bag", camera_items(2))
    (bag / "bag.mcap").unlink()
    text = (bag / "metadata.yaml").read_text()
    (bag / "metadata.yaml").write_text(text.replace("bag.mcap", "../other/other.mcap"))
    with pytest.raises(RecordingError):
        open_source(bag)


@pytest.mark.parametrize("name", ["../x", "/etc", "..", "", "a/b"])
def test_a_scan_is_the_name_of_a_folder(tmp_path, name):
    annotations = Annotations(write_dataset(tmp_path, {"a": ([("chair", 1)], [])}), "replica")
    assert annotations.scan_folder("a").parent == tmp_path / "data"
    with pytest.raises(RecordingError, match="expected the name of a folder in data/"):
        annotations.scan_folder(name)


def test_a_clip_of_an_index_is_in_its_folder(tmp_path, secret):
    from deworldsg_ros.scene.errors import ConfigurationError
    from deworldsg_ros.training.clips import read_clip_folder

    (tmp_path / "clips").mkdir()
    line = '{"clip": "../secret.png", "predicate": "on", "group": "g"}'
    (tmp_path / "clips" / "index.jsonl").write_text(line)
    with pytest.raises(ConfigurationError, match=r"clip '\.\./secret.png': it leaves the folder"):
        read_clip_folder(tmp_path / "clips")
