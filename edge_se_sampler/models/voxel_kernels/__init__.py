"""`voxel_ops` for float32 on a CPU, compiled by numba (extra [fast]): the same functions, and the same results but for
rounding, for any number of threads."""

from edge_se_sampler.models.voxel_kernels.compositing import composite
from edge_se_sampler.models.voxel_kernels.marching import find_dense_cells, march
from edge_se_sampler.models.voxel_kernels.rows import adam_rows, interpolate, resample
from edge_se_sampler.models.voxel_kernels.shading import shade

__all__ = ["adam_rows", "composite", "find_dense_cells", "interpolate", "march", "resample", "shade"]
