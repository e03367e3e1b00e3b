"""Measure tactflow and its peers, and write the page about it.

    python -m lab.peers --data ../shared/data --page docs/peers.md
    python -m lab.peers --page docs/peers.md --only       # the page again, from the numbers beside it

Needs `make peers`. Without the peers, tactflow and the original script are measured alone. The numbers of
parts that are not measured are kept.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import metadata, util
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from lab.peers import contact, depth, dots, page
from lab.peers.common import FAILURES, errors_of, lines, one_thread, recording
from tactflow.tools.bench.run import machine
from tactflow.tools.bench.scenes import Case
from tactflow.tools.bench.timing import quiet

SCENES: Final = "press cable twist strong_shear slide jumps jumps_worn dense square_dots tilted noisy flicker"
CONTACTS: Final = "press bright cable bright_cable edge box ring screw two border drift flicker"
QUERIES: Final = {"jumps_worn": Case("jumps", 0, "worn=0.05&missing=0.05&vanish=0.05", "_worn")}
PACKAGE: Final = {"trackpy": "trackpy", "pytouch": "pytouch", depth.NETWORK: "torch"}
"""Method -> the module without which it is left out."""
ATTEMPTS: Final = {
    "gs_sdk": "from gs_sdk.gs_reconstruct import Reconstructor",
    "pytouch": "from pytouch.sensors import DigitSensor; from pytouch.tasks import TouchDetect; "
    "TouchDetect(DigitSensor)",
    "opentouch-interface": "import opentouch_interface",
    "xensesdk": "from xensesdk import Sensor; Sensor.create(0)",
}
"""Package -> what is measured of it, in an environment of its own if there is one."""
OWN: Final = Path(".venv-peers-others")


def cases(names: str, frames: int) -> list[Case]:
    """Scenes of so many frames."""
    known = [QUERIES.get(name, Case(name, 0)) for name in names.split()]
    return [Case(case.name, frames, case.query, case.suffix) for case in known]


def available(methods: Any) -> list[str]:
    """The methods whose packages are installed."""
    return [name for name in methods if name not in PACKAGE or util.find_spec(PACKAGE[name])]


def attempts() -> list[dict[str, str]]:
    """What happens when a package is tried that cannot be measured, by its last line."""
    answers = []
    for package, statement in ATTEMPTS.items():
        own = OWN / package / "bin/python"
        python = str(own if own.exists() else sys.executable)
        done = subprocess.run(
            [python, "-W", "ignore", "-c", statement], capture_output=True, text=True, timeout=300
        )
        messages = done.stderr.strip().splitlines()
        version = subprocess.run(
            [python, "-c", f"from importlib.metadata import version; print(version({package!r}))"],
            capture_output=True,
            text=True,
        ).stdout.strip()
        error = messages[-1] if done.returncode and messages else "no error"
        answers.append({"package": package, "version": version, "tried": statement, "error": error})
    return answers


def memory(methods: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Peak memory of a process that runs one method over a scene, MB, and of one that runs none."""

    def peak(name: str) -> float:
        command = [sys.executable, "-W", "ignore", "-m", "lab.peers", "--memory-of", name]
        return float(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()[-1])

    peaks = {
        quantity: {name: peak(f"{quantity}/{name}") for name in names} for quantity, names in methods.items()
    }
    return peaks | {"bench alone": peak("")}


def run_once(name: str) -> None:
    """Run a method of dots or contact over a scene, and print the peak of the memory, MB."""
    quantity, _, method = name.partition("/")
    with TemporaryDirectory() as folder:
        scene = recording(Case("press", 40), Path(folder))
    for module in (dots, contact):
        if module.__name__.endswith(f".{quantity}"):
            settings = {key: values[0] for key, values in module.CHOICES.get(method, {}).items()}
            errors_of(module.follow, scene, method, settings)
    print(int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 1024)


def code() -> dict[str, dict[str, int]]:
    """Lines that a user of each method writes."""
    parts = {"trackpy": [dots.locate], "OpenCV Lucas-Kanade": [dots.corners]}
    network = (depth.PixelNetwork, depth.train, depth.integrate, depth.on_ball)
    return {
        "dots": {n: sum(map(lines, [method, *parts.get(n, [])])) for n, method in dots.METHODS.items()},
        "contact": {name: lines(adapter) for name, adapter in contact.ADAPTERS.items()},
        "depth": {"tactflow": lines(depth.Tactflow), depth.NETWORK: sum(map(lines, network))},
    }


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m lab.peers", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--data", type=Path, default=Path("../shared/data"), help="real recordings")
    parser.add_argument("--page", type=Path, default=Path("out/peers.md"), help="the numbers go beside it")
    parser.add_argument("--frames", type=int, default=40, help="of each simulated scene")
    parser.add_argument("--wide", type=int, default=60, help="random sensors that are judged")
    parser.add_argument("--only", nargs="*", metavar="PART", help="measure only these, and keep the others")
    parser.add_argument("--memory-of", metavar="QUANTITY/METHOD", help=argparse.SUPPRESS)
    args = parser.parse_args()
    one_thread()
    if args.memory_of is not None:
        run_once(args.memory_of)
        return
    names = {"dots": available(dots.METHODS), "contact": available(contact.PEERS)}
    network = bool(available([depth.NETWORK]))
    with TemporaryDirectory() as scratch, quiet():
        folder = Path(scratch)
        parts: dict[str, Callable[[], Any]] = {
            "dots": lambda: dots.on_named(cases(SCENES, args.frames), folder, names["dots"]),
            "dots_wide": lambda: dots.on_wide(args.wide, names["dots"]),
            "contact": lambda: contact.on_named(cases(CONTACTS, args.frames), folder, names["contact"]),
            "contact_wide": lambda: contact.on_wide(args.wide, names["contact"]),
            "dots_gels": lambda: dots.on_gels(args.data, names["dots"]),
            "contact_gels": lambda: contact.on_gels(args.data, names["contact"]),
            "depth": lambda: depth.on_balls(args.data, network),
            "memory": lambda: memory(names | {"contact": [contact.OURS, *names["contact"]]}),
            "code": code,
            "attempts": attempts,
        }
        stored = args.page.with_suffix(".json")
        numbers = json.loads(stored.read_text()) if stored.exists() else {}
        args.page.parent.mkdir(parents=True, exist_ok=True)
        for part in parts if args.only is None else args.only:
            began = time.monotonic()
            FAILURES.clear()
            numbers[part] = parts[part]()
            numbers.setdefault("failures", {})[part] = {
                name: dict(counts) for name, counts in FAILURES.items()
            }
            # One for the bench itself: what is above it, others took.
            now = {"date": time.strftime("%Y-%m-%d", time.gmtime()), "load": f"{os.getloadavg()[1]:.0f}"}
            numbers["machine"] = machine() | now | versions()
            stored.write_text(json.dumps(numbers, indent=1) + "\n")
            print(f"{part}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    if unmeasured := set(parts) - set(numbers):
        parser.error(f"--only: {', '.join(sorted(unmeasured))} were never measured; there is no page yet")
    page.write(numbers, args.page)


def versions() -> dict[str, str]:
    """Installed versions of the peers."""
    found = {}
    for package in ("trackpy", "pytouch", "torch"):
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


if __name__ == "__main__":
    main()
