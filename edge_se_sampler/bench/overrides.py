"""Frozen, nested configs with some of their fields replaced."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

Config = TypeVar("Config")

SAMPLER = "pipeline.datamanager.pixel_sampler"
MANAGER = "pipeline.datamanager"
MODEL = "pipeline.model"


def override(config: Config, changes: Mapping[str, Any]) -> Config:
    """The config with the fields at dotted paths replaced, e.g. {"pipeline.model.width": 64}."""
    for path, value in changes.items():
        name, _, rest = path.partition(".")
        new = override(getattr(config, name), {rest: value}) if rest else value
        config = replace(config, **{name: new})  # pyright: ignore[reportArgumentType, reportCallIssue]
    return config
