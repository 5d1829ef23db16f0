"""Runs as data: presets, the runner, figures."""
