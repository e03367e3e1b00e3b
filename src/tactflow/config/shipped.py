"""Finding the pipeline file of a command."""

from __future__ import annotations

import re
from importlib.resources import as_file, files
from itertools import takewhile
from pathlib import Path

import yaml

from tactflow.config.document import SOURCE_OPTION
from tactflow.engine.errors import ConfigError
from tactflow.system.spelling import did_you_mean


def packaged_pipelines() -> list[str]:
    """Names of the shipped pipelines, without `.yaml`."""
    folder = files("tactflow.pipelines")
    return sorted(item.name.removesuffix(".yaml") for item in folder.iterdir() if item.name.endswith(".yaml"))


def described_pipelines() -> dict[str, str]:
    """Name -> description: the first sentence of the comment at the top of its file."""
    descriptions = {}
    for name in packaged_pipelines():
        lines = _packaged(name).read_text(encoding="utf-8").splitlines()
        comment = " ".join(line[2:] for line in takewhile(lambda line: line.startswith("# "), lines))
        descriptions[name] = re.split(r"\. |\.$", comment)[0]
    return descriptions


def default_stages() -> list[str]:
    """Ids of the stages of the shipped default pipeline, in its order; each is also the stage's name.

    >>> default_stages()[:2]
    ['capture', 'probe']
    """
    return list(yaml.safe_load(_packaged("default").read_text(encoding="utf-8"))["stages"])


def find_pipeline(name: str | None) -> Path:
    """The file for the argument PIPELINE.

    None: `./pipeline.yaml` if it exists, else the shipped default. A name that is not a file, such as
    `classic` or `pipelines/classic.yaml`, is a shipped pipeline.

    Raises ConfigError, with the valid names, if it is neither.
    """
    if name is None:
        local = Path("pipeline.yaml")
        return local if local.exists() else _packaged("default")
    path = Path(name)
    stem = path.name.removesuffix(".yaml")
    if not path.exists() and stem in packaged_pipelines() and path.parent in (Path(), Path("pipelines")):
        return _packaged(stem)
    if not path.exists() and name == stem and path.parent == Path():
        raise ConfigError(
            f"there is no file {name}, and no pipeline of that name in tactflow"
            f"{did_you_mean(name, packaged_pipelines(), 'it has ')}; {SOURCE_OPTION} {name}"
        )
    return path


def is_packaged(folder: Path) -> bool:
    """Whether a folder is that of the shipped pipelines."""
    return folder.resolve() == _packaged("default").parent.resolve()


def _packaged(stem: str) -> Path:
    with as_file(files("tactflow.pipelines") / f"{stem}.yaml") as path:
        return path
