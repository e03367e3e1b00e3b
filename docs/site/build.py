"""Build the site: `make docs`, or `python packaging/lock.py install docs; python docs/site/build.py OUT`.

The pages are README.md, docs/*.md, CONTRIBUTING.md and CHANGELOG.md as they are. Here they are copied into
one folder, with links to where the site has them. Pages for the public names and for the gallery are added,
and those that quick runs of `tactflow bench` and `tactflow stress` write. Then Sphinx makes the site. Its
warnings, such as that of a broken link, are errors.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

HERE: Final = Path(__file__).resolve().parent
REPOSITORY: Final = HERE.parents[1]
NAMES: Final = {
    "README.md": "index.md",
    "docs/README.md": "guide.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changes.md",
}
"""Page -> its name on the site; a page `docs/NAME.md` is `NAME.md`."""
BESIDE_THE_GUIDE: Final = {"guide", "index", "changes", "accuracy", "peers"}
"""Pages that have their own place in the navigation, not within the guide."""
COPIED: Final = (".jpg", ".png", ".h")
"""Files of docs/ that pages show or link to."""
LINKED: Final = ("examples", "pipelines", "plugins")
"""Folders with files that pages link to."""
MEASURED: Final = {"bench": "accuracy.md", "stress": "stability.md"}
"""Command that writes a page of plots -> page of the site that links to it."""
ROOT: Final = """
```{toctree}
:hidden:

guide
gallery/index
Reference <api>
Accuracy <accuracy>
Peers <peers>
changes
```
"""


def stage(source: Path) -> None:
    """Write all pages of the site, as Markdown and Python, into a new folder."""
    for page in [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("docs/*.md")]:
        path = page.relative_to(REPOSITORY).as_posix()
        text = page.read_text(encoding="utf-8")
        (source / site_name(path)).write_text(with_links(text, page.parent), encoding="utf-8")
    for kind in COPIED:
        for file in REPOSITORY.glob(f"docs/**/*{kind}"):
            copy = source / file.relative_to(REPOSITORY / "docs")
            copy.parent.mkdir(exist_ok=True)
            shutil.copyfile(file, copy)
    for folder in LINKED:
        shutil.copytree(REPOSITORY / folder, source / folder, ignore=shutil.ignore_patterns("__pycache__"))
    with (source / "index.md").open("a", encoding="utf-8") as index:
        index.write(ROOT)
    pages = sorted({page.stem for page in source.glob("*.md")} - BESIDE_THE_GUIDE)
    with (source / "guide.md").open("a", encoding="utf-8") as guide:
        guide.write("\n".join(["", "```{toctree}", ":hidden:", "", *pages, "```", ""]))
    (source / "api.md").write_text(reference(), encoding="utf-8")
    shutil.copyfile(HERE / "conf.py", source / "conf.py")
    shutil.copytree(HERE / "static", source / "static")


def measure(source: Path) -> None:
    """Write the pages of plots, by quick runs, and link to them."""
    folder = source / "measured"
    folder.mkdir()
    for command, page in MEASURED.items():
        outputs = ["--page", str(folder / f"{command}.html"), "--json", str(source / f"{command}.json")]
        words = [sys.executable, "-m", "tactflow", command, "--quick", *outputs]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        link = (
            f'<a href="{command}.html">The page of `tactflow {command} --quick`</a>, written with this site.'
        )
        with (source / page).open("a", encoding="utf-8") as text:
            text.write(f"\n{link}\n")


def site_name(path: str) -> str:
    """File name on the site of a page, given relative to the repository."""
    return NAMES.get(path, path.removeprefix("docs/"))


def with_links(text: str, folder: Path) -> str:
    """The text of a page of `folder` with the relative links that the site has."""

    def moved(link: re.Match[str]) -> str:
        path = (folder / link[2]).resolve().relative_to(REPOSITORY).as_posix()
        return f"{link[1]}{site_name(path)}"

    return re.sub(r"(\]\(|src=\")(?!\w+:|#)([^)\s#\"]+)", moved, text)


def reference() -> str:
    """The page of the public names, in the order of `tactflow.__all__`: functions and types."""
    import tactflow

    lines = [
        "# Python reference",
        "",
        "What `import tactflow` provides. Every example is run by the tests.",
        "",
    ]
    groups = {"Functions": str.islower, "Classes": lambda name: not name.islower()}
    for title, belongs in groups.items():
        names = [name for name in tactflow.__all__ if belongs(name)]
        rows = [
            "```{eval-rst}",
            ".. currentmodule:: tactflow",
            "",
            ".. autosummary::",
            "   :toctree: api",
            "",
        ]
        lines += [f"## {title}", "", *rows, *(f"   {name}" for name in names), "```", ""]
    return "\n".join(lines)


def main() -> int:
    """Build; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder for the site; what is there is removed")
    out = parser.parse_args().out.resolve()
    from sphinx.cmd.build import build_main

    shutil.rmtree(out, ignore_errors=True)
    work = out.with_name(f"{out.name}-source")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    stage(work)
    measure(work)
    return build_main(["--fail-on-warning", "--quiet", "-d", f"{work}/.doctrees", str(work), str(out)])


if __name__ == "__main__":
    sys.exit(main())
