"""Which pipeline file a command means."""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path


def packaged_pipelines() -> list[str]:
    """Names of the pipelines that come with the package, without `.yaml`."""
    folder = files("tactflow.pipelines")
    return sorted(item.name.removesuffix(".yaml") for item in folder.iterdir() if item.name.endswith(".yaml"))


def find_pipeline(name: str | None) -> Path:
    """The file that PIPELINE names.

    Without a name: `./pipeline.yaml` if it is there, else the packaged default. A name that is no file, such
    as `classic` or `pipelines/classic.yaml`, finds the packaged pipeline of that name.
    """
    if name is None:
        local = Path("pipeline.yaml")
        return local if local.exists() else _packaged("default")
    path = Path(name)
    stem = path.name.removesuffix(".yaml")
    if not path.exists() and stem in packaged_pipelines() and path.parent in (Path(), Path("pipelines")):
        return _packaged(stem)
    return path


def is_packaged(folder: Path) -> bool:
    """Whether a folder is the one in which the pipelines of the package stand."""
    return folder.resolve() == _packaged("default").parent.resolve()


def _packaged(stem: str) -> Path:
    with as_file(files("tactflow.pipelines") / f"{stem}.yaml") as path:
        return path
