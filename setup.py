"""What pyproject.toml cannot say: loops in C, packages beside src/, a README whose links work on an index."""

import os
import re
import sys
import sysconfig
from pathlib import Path

from setuptools import Extension, find_packages, setup

REPOSITORY = os.environ.get("GITHUB_REPOSITORY")
"""Owner and name, as set where the packages of a release are built. Without it, links stay relative."""
VERSION = os.environ.get("GITHUB_REF_NAME", "main")
"""Tag or branch that the links lead to."""
ADDRESS = f"{os.environ.get('GITHUB_SERVER_URL', 'https://github.com')}/{REPOSITORY}"


def absolute(link: re.Match[str]) -> str:
    """The end of a Markdown link, `](docs/view.md)`, with the address of the file."""
    path = link[1]
    return f"]({ADDRESS}/{'raw' if path.endswith('.jpg') else 'blob'}/{VERSION}/{path})"


ORDER = [
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fassociative-math",
    "-fno-signed-zeros",
    "-freciprocal-math",
]
"""Sums of floats in any order, so that they run in vector registers; NaN and infinity still count."""
STABLE = not sysconfig.get_config_var("Py_GIL_DISABLED")
"""Whether the stable interface of Python 3.11 can be used: then one wheel serves that and all later ones."""
kernels = Extension(
    "tactflow.vision._kernels",
    ["src/tactflow/vision/kernels.c"],
    depends=[str(path) for path in sorted(Path("src/tactflow/vision/loops").glob("*.h"))],
    define_macros=[("Py_LIMITED_API", "0x030B0000")] if STABLE else [],
    extra_compile_args=["/O2", "/fp:fast"] if sys.platform == "win32" else ["-O3", "-g0", *ORDER],
    py_limited_api=STABLE,
    optional=True,  # where there is no C compiler, loops run in NumPy
)

readme = Path(__file__).with_name("README.md").read_text(encoding="utf-8")
published = {"Source": ADDRESS, "Changes": f"{ADDRESS}/blob/{VERSION}/CHANGELOG.md"}
setup(
    ext_modules=[kernels],
    exclude_package_data={"": ["*.c", "*.h"]},
    options={"bdist_wheel": {"py_limited_api": "cp311"}} if STABLE else {},
    packages=[
        *find_packages("src"),
        "tactflow.view.page",
        "tactflow.stages",
        "tactflow.sinks",
        "tactflow.pipelines",
        "tactflow.plugins",
        *(f"tactflow.plugins.{path.parent.name}" for path in sorted(Path("plugins").glob("*/__init__.py"))),
    ],
    long_description=re.sub(r"\]\((?!\w+:|#)([^)\s]+)\)", absolute, readme) if REPOSITORY else readme,
    long_description_content_type="text/markdown",
    project_urls=published if REPOSITORY else {},
)
