"""`voxel_ops` for float32 on a CPU, compiled by numba (extra [fast]): the same functions, and the same results but for
rounding, for any number of threads."""

import numba

from edge_se_sampler.models.voxel_kernels.marching import find_dense_cells
from edge_se_sampler.models.voxel_kernels.rendering import render
from edge_se_sampler.models.voxel_kernels.rows import adam_rows, resample

__all__ = ["adam_rows", "find_dense_cells", "render", "resample", "set_num_threads"]


def set_num_threads(count: int) -> None:
    """Use so many threads, if numba has them."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))  # pyright: ignore
