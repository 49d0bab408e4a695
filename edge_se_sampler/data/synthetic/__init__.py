"""Synthetic scenes: seven small analytic stand-ins for NeRF's Blender scenes, rendered with numpy alone."""

from __future__ import annotations

from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF, SCENE_NAMES
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.data.synthetic.render import render_view

__all__ = ["ANALOG_OF", "SCENE_NAMES", "make_scenes", "render_view"]
