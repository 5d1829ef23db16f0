"""Runs as data: presets, the runner, figures."""

from sb3_ars.experiments.catalogue import (
    PRESETS,
    PresetInfo,
    find_presets,
    preset_group,
    preset_info,
    preset_names,
)

__all__ = ["PRESETS", "PresetInfo", "find_presets", "preset_group", "preset_info", "preset_names"]
