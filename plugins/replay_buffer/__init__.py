"""Replay buffers of Diffusion Policy: an export. As sources, `plugins/arrays` reads them."""
