"""What nerfstudio loads: the methods, or None for each if they cannot be had.

It loads entry points unguarded, so an exception here would break every `ns-train`; None it passes over with a warning.
"""

from __future__ import annotations

import sys
from typing import Any

METHODS: dict[str, Any] = {}
try:
    from edge_se_sampler.nerfstudio.plugin import METHODS
except Exception as problem:  # whatever another version of nerfstudio, or half of one, may raise
    print(f"edge-se-sampler: its methods are left out of nerfstudio: {problem!r}", file=sys.stderr)

edge_nerf = METHODS.get("edge-nerf")
edge_se_nerf = METHODS.get("edge-se-nerf")
se_nerf = METHODS.get("se-nerf")
precrop_nerf = METHODS.get("precrop-nerf")
precrop_se_nerf = METHODS.get("precrop-se-nerf")
edge_se_nerfacto = METHODS.get("edge-se-nerfacto")
lean_nerf = METHODS.get("lean-nerf")
