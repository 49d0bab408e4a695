"""What `edge-se export RUN` writes, and the flags of each. Torch-free until one runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edge_se_sampler.engine.config import TrainerConfig
    from edge_se_sampler.engine.run_folder import RunFolder


@dataclass(frozen=True)
class ExportMesh:
    """A watertight surface with colors, in the data's units: .ply in its axes, .glb turned so that z becomes y."""

    output_path: Path = Path("mesh.ply")
    """The file to write, .ply or .glb."""
    opacity_threshold: float = 0.1
    """Opacity across a cell, in (0, 1), at which the surface lies: with the default a trained ball keeps its size; with
    more of it, shiny surfaces get holes."""
    keep_components: int = 1
    """How many of the surface's connected parts are kept, the largest first; 0: all."""
    tolerance: float = 0.0
    """How far the surface may move, in cells, to have fewer faces, and coarser colors; 0: it keeps all."""
    picture: Path | None = None
    """A PNG to write as well: a held-out image, the model's rendering of that view, and the mesh from the same camera,
    in its colors and shaded in gray. The mesh's distance from the rendered depth is printed, in pixels."""
    picture_view: int = 0
    """Number of that held-out image."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.mesh import export_mesh

        return export_mesh(run, config, **vars(self))


@dataclass(frozen=True)
class ExportPoints:
    """Points with normals and colors, as the training views see them: what Gaussian splatting can begin from."""

    output_path: Path = Path("points.ply")
    """The .ply to write."""
    num_points: int = 200_000
    """Points, if that many of the training views' pixels show something."""
    seed: int = 0
    """Seed of the pixels that are chosen."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.points import export_points

        return export_points(run, config, self.output_path, self.num_points, self.seed)


@dataclass(frozen=True)
class ExportSplats(ExportPoints):
    """A flat Gaussian for each of those points, in the format that viewers of 3D Gaussian splatting open."""

    output_path: Path = Path("splats.ply")
    """The .ply to write."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.splats import export_splats

        return export_splats(run, config, self.output_path, self.num_points, self.seed)


@dataclass(frozen=True)
class ExportCameras:
    """The data's images and cameras, held-out ones too, as nerfstudio's transforms.json. It names the points.ply beside
    it, if there is one: with both in FOLDER, ns-train splatfacto nerfstudio-data --data FOLDER begins from it."""

    output_path: Path = Path("transforms.json")
    """The json to write; files are named relative to its folder."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.cameras import export_cameras

        return export_cameras(config, self.output_path)
