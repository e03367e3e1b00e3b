"""Missing packages are named with what to install."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def test_a_recording_without_the_packages_for_it_is_refused_with_the_command_that_installs_them(
    tmp_path: Path,
) -> None:
    (tmp_path / "press.mcap").touch()
    program = (
        "import sys; sys.modules['zstandard'] = sys.modules['mcap'] = None; "
        "from tactflow.cli.main import main; sys.exit(main(['run', 'mini', '--source', 'press.mcap']))"
    )
    ended = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode == 4
    assert "pip install 'tactflow[record]'" in ended.stderr
    assert "Traceback" not in ended.stderr
