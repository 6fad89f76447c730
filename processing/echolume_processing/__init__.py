"""Pure functions from raw data to the map, and the subscribers that carry them between the bus and the recording."""

from pathlib import Path

from echolume_processing.kernel_cache import forget_stale_kernels

forget_stale_kernels(Path(__file__).parent)
