"""The seven synthetic scenes, one file each, and the scene of NeRF's Blender set that each stands in for."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache

from edge_se_sampler.data.synthetic.catalogue.bricks import bricks
from edge_se_sampler.data.synthetic.catalogue.chair import chair
from edge_se_sampler.data.synthetic.catalogue.drums import drums
from edge_se_sampler.data.synthetic.catalogue.ficus import ficus
from edge_se_sampler.data.synthetic.catalogue.hotdog import hotdog
from edge_se_sampler.data.synthetic.catalogue.materials import materials
from edge_se_sampler.data.synthetic.catalogue.mic import mic
from edge_se_sampler.data.synthetic.scene import Scene, SceneBuilder
from edge_se_sampler.errors import InputError

_BUILDERS = {builder.__name__: builder for builder in (chair, drums, ficus, hotdog, bricks, materials, mic)}
SCENE_NAMES = tuple(_BUILDERS)
ANALOG_OF = {name: "lego" if name == "bricks" else name for name in SCENE_NAMES}


@cache
def synthetic_scene(name: str) -> Scene:
    """The scene called `name`, built once. Raises InputError if there is none; the message names the nearest."""
    check_name(name)
    builder = SceneBuilder()
    _BUILDERS[name](builder)
    return builder.build()


def check_name(name: str) -> None:
    """Raises InputError if no synthetic scene is called `name`."""
    if name not in _BUILDERS:
        known = {ANALOG_OF[scene]: scene for scene in SCENE_NAMES} | {scene: scene for scene in SCENE_NAMES}
        nearest = known[get_close_matches(name, known, n=1, cutoff=0)[0]]
        names = ", ".join(SCENE_NAMES)
        raise InputError(f"no synthetic scene is called {name!r}: did you mean {nearest!r}? There are {names}")
