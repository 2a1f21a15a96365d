"""`deworldsg models get`, `list` and `inspect`."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from deworldsg_ros.checkpoints.catalogue import (
    CATALOGUE,
    GROUPS,
    NOT_ON_THE_HUB,
    Published,
    is_complete,
)
from deworldsg_ros.checkpoints.headers import ParameterHeader, read_headers
from deworldsg_ros.checkpoints.hub import SUMS_FILE, Hub
from deworldsg_ros.checkpoints.required import is_hub_id
from deworldsg_ros.scene.errors import ConfigurationError
from deworldsg_ros.words import visible


def get_models(names: list[str], into: Path, console: Console) -> None:
    """Download models by name; see `deworldsg models get`.

    Raises:
        ConfigurationError: an unknown name, no access, no network, or a file that is damaged.
    """
    chosen = [model for name in names for model in _models(name)]
    if "embedded" in names:
        console.print("embedded: the weights are part of the package; nothing to download")
    if chosen:
        hub = Hub()
        for published in chosen:
            model, folder = hub.find(published.repository), into / published.name
            console.print(
                f"{model.repository}, commit {model.commit[:12]}, licence {model.licence}, "
                f"{model.size / 1e9:.2f} GB → {folder}"
            )
            _make_folder(folder)
            hub.fetch(model, folder, lambda line: console.print(f"  {line}"))
    if "paper" in names:
        for name, title, advice in NOT_ON_THE_HUB:
            if not (into / name).is_dir():
                console.print(f"{title} is not on the hub: {advice.format(folder=into / name)}")


def list_models(folder: Path, console: Console) -> None:
    """Print what a folder of models has, what is missing, and how to bring it to a machine."""
    console.print("in the package: NanoDet-g (detector), embedded world model; no download")
    paper = GROUPS["paper"]
    for name, model in CATALOGUE.items():
        state = _state(folder / name)
        mark = ", of config/paper.yaml" if name in paper else ""
        console.print(f"{state:10} {name}: {model.purpose}{mark}; licence {model.licence}")
    for name, title, advice in NOT_ON_THE_HUB:
        state = _state(folder / name)
        how = "" if state == "there" else f"; {advice.format(folder=folder / name)}"
        console.print(f"{state:10} {name}: {title}, of config/paper.yaml{how}")
    known = {*CATALOGUE, *(name for name, _, _ in NOT_ON_THE_HUB)}
    others = sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []
    for name in others:
        if name not in known and is_complete(folder / name):
            console.print(f"{'there':10} {name}")
    console.print(
        f"\nget one: deworldsg models get NAME --into {folder}\n"
        f"for a machine without network: run that elsewhere, copy the folder {folder}, and run "
        f"`sha256sum -c {SUMS_FILE}` in each of its folders there"
    )


def inspect_file(path: Path, console: Console) -> None:
    """Print names, dtypes and shapes of the parameters of a file, or of the files of a folder."""
    paths = sorted(path.glob("*.safetensors")) if path.is_dir() else [path]
    if not paths:
        raise ConfigurationError(f"{path} has no *.safetensors: expected a file or such a folder")
    for file in paths:
        headers = read_headers(file)
        values = sum(_values(header) for header in headers)
        console.print(f"{file.name}: {len(headers)} parameters, {values / 1e6:.2f} million values")
        for header in headers:
            shape = " x ".join(map(str, header.shape)) or "scalar"
            console.print(f"  {visible(header.name)}  {header.dtype}  {shape}")


def _models(name: str) -> list[Published]:
    if name in GROUPS:
        return [CATALOGUE[member] for member in GROUPS[name]]
    if name in CATALOGUE:
        return [CATALOGUE[name]]
    if is_hub_id(name):
        return [Published(name.partition("/")[2], name, "", "")]
    raise ConfigurationError(
        f"model '{name}' is unknown: expected {', '.join((*GROUPS, *CATALOGUE))}, or OWNER/NAME of "
        "the hub"
    )


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigurationError(f"--into {folder.parent}: {error.strerror}") from error


def _state(folder: Path) -> str:
    if not folder.is_dir():
        return "missing"
    return "there" if is_complete(folder) else "incomplete"


def _values(header: ParameterHeader) -> int:
    count = 1
    for size in header.shape:
        count *= size
    return count
