"""Where tasks run: in this process, in processes of this machine, on a Dask cluster. The only room that imports distributed."""

from .dask_cluster import cluster, versions
from .work import Pool, Serial, Work, WorkersNotStartedError, processes
