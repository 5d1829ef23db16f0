"""Runs as data: presets, the runner, figures."""

from importlib import resources

PRESETS = resources.files(__name__) / "presets"
"""Folder of the presets that ship with the package, one YAML file each."""


def preset_names() -> list[str]:
    """Return the names of the presets."""
    return sorted(
        path.name.removesuffix(".yaml") for path in PRESETS.iterdir() if path.name.endswith(".yaml")
    )
