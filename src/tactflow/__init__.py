"""tactflow: from camera frames of a tactile sensor to contact geometry and marker flow."""

from __future__ import annotations

__version__ = "0.1.0"
