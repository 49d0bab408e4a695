"""The paper's strategies, and its tables 1 to 4: PSNR in dB on NeRF's Blender scenes, one seed; not its averages, which
are truncated.

Important Pixels Sampling for NeRF Training Based on Edge Values and Squared Errors, section 4.
"""

from __future__ import annotations

LABELS = {
    "vanilla-nerf": "Random",
    "precrop-nerf": "Precrop + Random",
    "se-nerf": "SE",
    "precrop-se-nerf": "Precrop + SE",
    "edge-nerf": "Edge",
    "edge-se-nerf": "Edge + SE",
}
"""Method -> label, in the order of the paper's tables."""
SCENES = ("chair", "drums", "ficus", "hotdog", "bricks", "materials", "mic")
"""Its columns under the names of the synthetic scenes; bricks stands in for Lego."""
REAL_SCENES = {"real-lego": "bricks", "real-chair": "chair"}
"""NeRF's own lego and chair -> their column."""

_TABLES = {
    1: """13.69 23.94 14.26 36.63 31.97 29.82 13.12
          33.42 26.36 29.36 36.87 31.85 29.65 32.88
          13.69 24.07 14.26 37.09 32.26 29.99 13.12
          33.73 26.62 29.61 37.36 32.27 29.89 33.33
          33.47 26.38 29.35 36.70 31.97 29.71 32.72
          33.90 26.55 29.70 37.14 32.18 29.84 33.19""",
    2: """13.69 11.12 14.26 29.40 25.60 22.82 13.12
          13.69 18.46 28.71 29.56 25.61 23.13 13.12
          13.69 11.12 14.26 29.07 25.73 22.76 13.12
          13.69 18.55 28.97 29.25 25.64 23.21 13.12
          27.13 19.38 28.88 29.72 29.56 23.02 29.38
          27.12 19.15 29.27 29.07 29.89 22.82 29.25""",
    3: """14.03 10.93 14.22 26.63 25.14 22.14 13.04
          25.45 19.19 22.87 26.40 24.91 22.07 26.91
          14.03 19.13 14.22 27.71 25.37 22.28 13.04
          25.68 18.89 22.86 27.22 24.89 22.05 27.12
          25.52 19.94 22.89 26.71 25.77 22.03 27.00
          25.75 19.83 22.89 27.55 26.03 22.05 27.38""",
    4: """14.03 17.50 14.22 22.20 21.84 8.73 13.04
          14.03 16.71 14.22 21.76 20.99 18.14 20.02
          14.03 17.44 14.22 22.25 21.82 8.73 13.04
          14.03 16.92 14.22 21.97 21.71 18.20 20.08
          22.38 17.50 21.87 22.13 21.30 18.21 20.69
          22.43 17.40 21.80 22.31 21.42 18.44 20.73""",
}


def published(table: int) -> dict[tuple[str, str], float]:
    """(strategy, scene) -> PSNR of a table, 1 to 4."""
    rows = [[float(number) for number in row.split()] for row in _TABLES[table].splitlines()]
    columns = {scene: SCENES.index(column) for scene, column in ({s: s for s in SCENES} | REAL_SCENES).items()}
    return {(name, scene): rows[i][j] for i, name in enumerate(LABELS) for scene, j in columns.items()}
