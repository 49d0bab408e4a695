"""Synthetic scenes: seven small analytic stand-ins for NeRF's Blender scenes, rendered with numpy alone."""

from __future__ import annotations

from edge_se_sampler.data.synthetic.cameras import Camera
from edge_se_sampler.data.synthetic.catalogue import ANALOG_OF, SCENE_NAMES, synthetic_scene
from edge_se_sampler.data.synthetic.folder import make_scenes
from edge_se_sampler.data.synthetic.render import render

__all__ = ["ANALOG_OF", "SCENE_NAMES", "Camera", "make_scenes", "render", "synthetic_scene"]
