"""The program `bridge`, also as `python -m tactflow_ros`."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the node, or report a missing package."""
    try:
        from tactflow_ros.bridge import main as run
    except ModuleNotFoundError as error:
        print(
            f"tactflow_ros: {error.name} is missing; it comes with ROS 2: source /opt/ros/jazzy/setup.bash, "
            "then apt install python3-zmq",
            file=sys.stderr,
        )
        return 1
    return run()


if __name__ == "__main__":
    sys.exit(main())
