"""What pyproject.toml cannot say: packages beside src/, and a README whose links work on a package index."""

import os
import re
from pathlib import Path

from setuptools import find_packages, setup

REPOSITORY = os.environ.get("GITHUB_REPOSITORY")
"""Owner and name, as set where the packages of a release are built. Without it, links stay relative."""
VERSION = os.environ.get("GITHUB_REF_NAME", "main")
"""Tag or branch that the links lead to."""
ADDRESS = f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{REPOSITORY}"


def absolute(link: re.Match[str]) -> str:
    """The end of a Markdown link, `](docs/view.md)`, with the address of the file."""
    path = link[1]
    return f"]({ADDRESS}/{'raw' if path.endswith('.jpg') else 'blob'}/{VERSION}/{path})"


readme = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
published = {"Source": ADDRESS, "Changes": f"{ADDRESS}/blob/{VERSION}/CHANGELOG.md"}
setup(
    packages=[
        *find_packages("src"),
        "tactflow.view.page",
        "tactflow.stages",
        "tactflow.sinks",
        "tactflow.pipelines",
        "tactflow.plugins",
        *(f"tactflow.plugins.{name}" for name in ("arrays", "lerobot", "onnx", "parquet", "rosbags")),
    ],
    long_description=re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", absolute, readme) if REPOSITORY else readme,
    long_description_content_type="text/markdown",
    project_urls=published if REPOSITORY else {},
)
