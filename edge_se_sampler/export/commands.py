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
    opacity_threshold: float = 0.5
    """Opacity across a cell, in (0, 1), at which the surface lies."""
    keep_components: int = 1
    """How many of the surface's connected parts are kept, the largest first; 0: all."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.mesh import export_mesh

        return export_mesh(run, config, self.output_path, self.opacity_threshold, self.keep_components)


@dataclass(frozen=True)
class ExportPoints:
    """A point cloud with normals and colors, seen by the training views, as Gaussian splats are begun from."""

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
class ExportCameras:
    """The data's images and cameras, held-out ones too, as nerfstudio's transforms.json; with the points.ply beside it
    named in it, ns-train splatfacto begins from those."""

    output_path: Path = Path("transforms.json")
    """The json to write; it names images relative to its folder."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.cameras import export_cameras

        return export_cameras(config, self.output_path)


@dataclass(frozen=True)
class ExportSplats:
    """One flat Gaussian for each of the points, in the format of 3D Gaussian Splatting's viewers."""

    output_path: Path = Path("splats.ply")
    """The .ply to write."""
    num_points: int = ExportPoints.num_points
    """Gaussians, if that many of the training views' pixels show something."""
    seed: int = 0
    """Seed of the pixels that are chosen."""

    def export(self, run: RunFolder, config: TrainerConfig) -> str:
        from edge_se_sampler.export.splats import export_splats

        return export_splats(run, config, self.output_path, self.num_points, self.seed)
